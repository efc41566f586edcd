# docker build -f docker/cuda.Dockerfile -t scas4d-cuda .
# The devel image: gsplat compiles its kernels at first use. TORCH_CUDA_ARCH_LIST names the GPU (9.0: H100, 8.9: L4).
FROM nvidia/cuda:12.8.1-devel-ubuntu24.04
RUN apt-get update && apt-get install -y --no-install-recommends python3 python3-dev python3-venv ninja-build \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /scas4d
COPY . .
RUN scripts/setup cuda
ENV SCAS4D_DATA=/data NUMBA_CACHE_DIR=/cache/numba TORCH_EXTENSIONS_DIR=/cache/torch TORCH_CUDA_ARCH_LIST=9.0
VOLUME ["/data", "/cache"]
EXPOSE 8000
CMD [".venv/bin/scas4d", "serve", "--host", "0.0.0.0", "--allow-remote"]
