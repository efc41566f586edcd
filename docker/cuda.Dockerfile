# docker build -f docker/cuda.Dockerfile -t scas4d-cuda .
# The devel image contains nvcc, with which gsplat compiles its kernels at first use. The CUDA of torch has to match it:
# torch from PyPI is built for CUDA 13, so a build for CUDA 12.8 is pinned here.
# TORCH_CUDA_ARCH_LIST is the architecture of the GPU (9.0: H100, 8.9: L4).
FROM nvidia/cuda:12.8.1-devel-ubuntu24.04
RUN apt-get update && apt-get install -y --no-install-recommends python3 python3-dev python3-venv ninja-build \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /scas4d
COPY . .
RUN python3 -m venv .venv \
    && .venv/bin/python -m pip install --no-cache-dir torch==2.11.0 --index-url https://download.pytorch.org/whl/cu128 \
    && scripts/setup cuda
ENV SCAS4D_DATA=/data NUMBA_CACHE_DIR=/cache/numba SCAS4D_HOST=0.0.0.0 \
    TORCH_EXTENSIONS_DIR=/cache/torch TORCH_CUDA_ARCH_LIST=9.0
VOLUME ["/data", "/cache"]
EXPOSE 8000
HEALTHCHECK --start-period=120s CMD .venv/bin/python -c "import urllib.request as u; u.urlopen('http://127.0.0.1:8000/health/live', timeout=5)"
STOPSIGNAL SIGTERM
CMD [".venv/bin/scas4d", "serve"]
