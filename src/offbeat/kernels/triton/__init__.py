"""The Triton backend of the scan: all rows in one launch forward, and one or a few backward.

It runs on CUDA devices, and with `TRITON_INTERPRET=1` in the environment, interpreted and slowly,
on the CPU. A program takes a block of trajectories through all rows; many models of equal shape
are one launch. `offbeat.kernels.triton.backend` starts the kernels.
"""
