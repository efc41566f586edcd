# docker build -f docker/cpu.Dockerfile -t scas4d .
FROM python:3.12-slim
WORKDIR /scas4d
COPY . .
RUN scripts/setup server
ENV SCAS4D_DATA=/data NUMBA_CACHE_DIR=/cache/numba
VOLUME ["/data", "/cache"]
EXPOSE 8000
# Inside the container all addresses; the compose file publishes on the host's loopback only.
CMD [".venv/bin/scas4d", "serve", "--host", "0.0.0.0", "--allow-remote"]
