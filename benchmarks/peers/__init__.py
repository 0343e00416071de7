"""Offbeat beside what people use instead, on the same values: see `docs/benchmarks_peers.md`."""
