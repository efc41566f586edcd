# The service with torch on a GPU: docker build -f docker/cuda.Dockerfile -t scas4d-cuda .
# This image was neither built nor run: only the steps that it shares with cpu.Dockerfile were. What the service itself
# needs is locked with hashes; torch and gsplat are pinned by version alone, because torch for CUDA 12.8 comes from an
# index of its own (torch from PyPI is built for CUDA 13). The digest is as in cpu.Dockerfile.
# The base contains nvcc, with which gsplat compiles its kernels at first use, into /cache; so it cannot be a small one.
# TORCH_CUDA_ARCH_LIST is the architecture of the GPU (9.0: H100, 8.9: L4); MAX_JOBS limits the compilers, of which each
# takes some GB of the container's memory.
ARG BASE=nvidia/cuda:12.8.1-devel-ubuntu24.04@sha256:520292dbb4f755fd360766059e62956e9379485d9e073bbd2f6e3c20c270ed66

FROM ${BASE} AS base
RUN apt-get update && apt-get install -y --no-install-recommends python3 python3-dev python3-venv ninja-build \
    && rm -rf /var/lib/apt/lists/*

FROM base AS build
WORKDIR /build
COPY docker/requirements.lock docker/build.lock ./
RUN python3 -m venv /opt/scas4d \
    && /opt/scas4d/bin/python -m pip install --no-cache-dir --require-hashes --only-binary :all: -r requirements.lock \
    && /opt/scas4d/bin/python -m pip install --no-cache-dir torch==2.11.0 \
        --index-url https://download.pytorch.org/whl/cu128 \
    && /opt/scas4d/bin/python -m pip install --no-cache-dir gsplat==1.5.3 \
    && python3 -m venv tools \
    && tools/bin/python -m pip install --no-cache-dir --require-hashes --only-binary :all: -r build.lock
COPY pyproject.toml README.md LICENSE ./
COPY scas4d_core scas4d_core
COPY server server
COPY client client
RUN tools/bin/python -m pip wheel --no-cache-dir --no-deps --no-build-isolation --wheel-dir wheel . \
    && /opt/scas4d/bin/python -m pip install --no-cache-dir --no-deps --no-index wheel/*.whl

FROM base
COPY --from=build /opt/scas4d /opt/scas4d
RUN install -d -o 10001 -g 10001 -m 700 /data /cache
ENV PATH=/opt/scas4d/bin:${PATH} HOME=/tmp PYTHONDONTWRITEBYTECODE=1 \
    SCAS4D_DATA=/data NUMBA_CACHE_DIR=/cache/numba SCAS4D_HOST=0.0.0.0 SCAS4D_PORT=8000 \
    TORCH_EXTENSIONS_DIR=/cache/torch TORCH_CUDA_ARCH_LIST=9.0 MAX_JOBS=2
USER 10001:10001
WORKDIR /tmp
VOLUME ["/data", "/cache"]
EXPOSE 8000
HEALTHCHECK --start-period=60s --interval=30s --timeout=10s \
    CMD ["python", "-c", "import os, urllib.request as u; \
        u.urlopen('http://127.0.0.1:%(SCAS4D_PORT)s/health/live' % os.environ, timeout=5)"]
CMD ["scas4d", "serve"]
