# semdb with the extras worker, serve, client and remote. docs/deployment.md says how to build and use it.
FROM python:3.11-slim AS build
WORKDIR /source
RUN pip install --no-cache-dir "build>=1.2,<2" "setuptools>=80,<90"
COPY pyproject.toml README.md LICENSE ./
COPY semdb semdb
COPY migrations migrations
COPY workers workers
RUN python -m build --wheel --no-isolation --outdir /dist .

FROM python:3.11-slim
RUN useradd --create-home --uid 1000 semdb \
    && mkdir /data /cache /uploads \
    && chown semdb:semdb /data /cache /uploads
COPY requirements/constraints.txt /tmp/constraints.txt
COPY --from=build /dist /dist
RUN pip install --no-cache-dir --constraint /tmp/constraints.txt "$(ls /dist/*.whl)[worker,serve,client,remote]" \
    && rm -rf /dist /tmp/constraints.txt
USER semdb
WORKDIR /data
ENV SEMDB_CACHE_DIR=/cache PYTHONUNBUFFERED=1
VOLUME ["/data", "/cache"]
CMD ["semdb", "--help"]
