# Offbeat on the CPU, with the readers of robotics formats and the simulator:
#   docker build -t offbeat .
#   docker run --rm -v "$PWD":/data offbeat inspect arm.csv
# Versions of Debian's packages are not pinned: it keeps only the latest of each.
FROM python:3.12-slim-bookworm AS build
# hadolint ignore=DL3008
RUN apt-get update && apt-get install --yes --no-install-recommends g++ \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY pyproject.toml constraints.txt CMakeLists.txt README.md LICENSE ./
COPY csrc csrc
COPY src src
RUN python -m venv /opt/offbeat \
    && /opt/offbeat/bin/pip install --no-cache-dir -c constraints.txt \
        --extra-index-url https://download.pytorch.org/whl/cpu torch \
    && PIP_BUILD_CONSTRAINT=constraints.txt /opt/offbeat/bin/pip install --no-cache-dir -c constraints.txt \
        '.[sim,ros,px4,hdf5]' \
    && /opt/offbeat/bin/python -c "from offbeat import kernels; assert kernels.cpu.instruction_sets()"

FROM python:3.12-slim-bookworm
# hadolint ignore=DL3008
RUN apt-get update && apt-get install --yes --no-install-recommends libegl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/offbeat /opt/offbeat
ENV PATH=/opt/offbeat/bin:$PATH MUJOCO_GL=egl OMP_NUM_THREADS=1
RUN useradd --create-home --uid 1000 user
USER 1000
WORKDIR /data
ENTRYPOINT ["offbeat"]
CMD ["--help"]
