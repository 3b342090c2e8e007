# The package with its dependencies. Not built by the gate, which has no Docker: see docs/limits.md.
#   CPU:   docker build -t gaussian_swaying .
#   CUDA:  docker build -t gaussian_swaying:cuda --build-arg BASE=nvidia/cuda:13.0.2-devel-ubuntu24.04 .
#          docker run --gpus all -v "$PWD/outputs:/work/outputs" gaussian_swaying:cuda sim --config flag
# The devel image has the nvcc with which gsplat compiles itself in its first run; a volume at /root/.cache keeps the result.
ARG BASE=ubuntu:24.04
FROM ${BASE}
RUN apt-get update && apt-get install -y --no-install-recommends python3 python3-venv python3-dev g++ && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH
WORKDIR /src
COPY . .
# without an nvcc there is no use for the gigabytes of CUDA that torch brings on Linux
RUN if command -v nvcc; then pip install --no-cache-dir -c constraints.txt . ; else \
    pip install --no-cache-dir -c constraints.txt --extra-index-url https://download.pytorch.org/whl/cpu . ; fi
WORKDIR /work
ENTRYPOINT ["gaussian-swaying"]
CMD ["--help"]
