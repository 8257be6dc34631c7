# The service on a slim image: no torch, no compiler, no root.
#   docker build -t caphy . && docker run --rm -p 8000:8000 -e CAPHY_API_KEY=... caphy
# Your own avatars: add -v "$PWD/avatars:/avatars:ro" -e CAPHY_AVATARS=/avatars
# It writes nothing but in /dev/shm (--read-only is fine): the numbers of several workers (CAPHY_WORKERS), and pose files
# dropped on the page while they are read.
# docs/operation.md has the settings. tests/docker runs these steps without an engine.

FROM python:3.11-slim AS build
WORKDIR /src
RUN python -m venv /opt/caphy
COPY pyproject.toml README.md LICENSE ./
COPY caphy caphy
COPY service service
COPY export export
RUN /opt/caphy/bin/pip install --no-cache-dir .

FROM python:3.11-slim
RUN useradd --system --no-create-home caphy
COPY --from=build /opt/caphy /opt/caphy
ENV PATH=/opt/caphy/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 \
    CAPHY_HOST=0.0.0.0 CAPHY_PORT=8000
USER caphy
EXPOSE 8000
HEALTHCHECK --interval=10s --timeout=3s --start-period=20s CMD \
    ["python", "-c", "import os, urllib.request as u; u.build_opener(u.ProxyHandler({})).open(f'http://127.0.0.1:{os.environ[\"CAPHY_PORT\"]}/ready', timeout=2)"]
CMD ["caphy", "serve"]
