# Image of the service. Build it from the repository root: docker build -f docker/cpu.Dockerfile -t scas4d .
# For NVIDIA GPUs (docker/compose.gpu.yaml), add: --build-arg LOCK=requirements-gpu.lock
# docker/try-image builds it without a Docker engine and runs it with the options of docker/compose.yaml.
# The digest was copied from public repositories that pin this tag, and was not resolved at the registry.
# docker/pin-images resolves and updates it.
ARG BASE=python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b

FROM ${BASE} AS build
ARG LOCK=requirements.lock
WORKDIR /build
COPY docker/requirements.lock docker/requirements-gpu.lock docker/build.lock ./
RUN python3 -m venv /opt/scas4d \
    && /opt/scas4d/bin/python -m pip install --no-cache-dir --require-hashes --only-binary :all: -r ${LOCK} \
    && find /opt/scas4d -type d -name tests -prune -exec rm -r {} + \
    && python3 -m venv tools \
    && tools/bin/python -m pip install --no-cache-dir --require-hashes --only-binary :all: -r build.lock
COPY pyproject.toml README.md LICENSE ./
COPY scas4d_core scas4d_core
COPY server server
COPY client client
COPY docs docs
COPY mkdocs.yml CONTRIBUTING.md CHANGELOG.md ./
COPY scripts/build_site.py scripts/
RUN tools/bin/python scripts/build_site.py
RUN tools/bin/python -m pip wheel --no-cache-dir --no-deps --no-build-isolation --wheel-dir wheel . \
    && /opt/scas4d/bin/python -m pip install --no-cache-dir --no-deps --no-index wheel/*.whl \
    && /opt/scas4d/bin/python -m pip uninstall --yes pip setuptools

FROM ${BASE}
COPY --from=build /opt/scas4d /opt/scas4d
# New volumes inherit the owner of these folders. The service writes only to them and to /tmp.
RUN install -d -o 10001 -g 10001 -m 700 /data /cache
ENV PATH=/opt/scas4d/bin:/usr/local/bin:/usr/bin:/bin HOME=/tmp PYTHONDONTWRITEBYTECODE=1 \
    SCAS4D_DATA=/data NUMBA_CACHE_DIR=/cache/numba WARP_CACHE_PATH=/cache/warp SCAS4D_HOST=0.0.0.0 SCAS4D_PORT=8000
USER 10001:10001
WORKDIR /tmp
VOLUME ["/data", "/cache"]
EXPOSE 8000
HEALTHCHECK --start-period=60s --interval=30s --timeout=10s \
    CMD ["python", "-c", "import os, urllib.request as u; \
        u.urlopen('http://127.0.0.1:%(SCAS4D_PORT)s/health/live' % os.environ, timeout=5)"]
# The service listens on all addresses of the container, so it does not start without a token. Set SCAS4D_TOKEN_FILE
# to the path of a mounted file, or SCAS4D_TOKEN to the token itself.
CMD ["scas4d", "serve"]
