# docker build -f docker/cpu.Dockerfile -t scas4d .
FROM python:3.12-slim
WORKDIR /scas4d
COPY . .
RUN scripts/setup server
ENV SCAS4D_DATA=/data NUMBA_CACHE_DIR=/cache/numba SCAS4D_HOST=0.0.0.0
VOLUME ["/data", "/cache"]
EXPOSE 8000
# The service does not start without SCAS4D_TOKEN or SCAS4D_TOKEN_FILE, because it listens at all addresses here.
HEALTHCHECK --start-period=120s CMD .venv/bin/python -c "import urllib.request as u; u.urlopen('http://127.0.0.1:8000/health/live', timeout=5)"
STOPSIGNAL SIGTERM
CMD [".venv/bin/scas4d", "serve"]
