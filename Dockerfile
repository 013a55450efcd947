FROM python:3.11-slim

# Shared libraries that the wheel of open3d expects of the system.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        libgl1 libgomp1 libx11-6 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/hmt
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY hmt_service ./hmt_service
RUN pip install --no-cache-dir -c constraints.txt .

RUN useradd --create-home --uid 1000 hmt \
    && install --directory --owner hmt --group hmt /data
USER hmt
# As the user who runs it: compiled code is looked for where that user may write.
RUN cd / && python -c 'from hmt_service.core import kernels; kernels.compile_all()'
# Maps and recordings: mount a volume here.
WORKDIR /data
VOLUME /data

EXPOSE 7447
HEALTHCHECK --interval=10s --timeout=5s --start-period=20s CMD ["hmt", "health"]
ENTRYPOINT ["hmt"]
# On loopback: run with --network host, or with --listen and --zenoh-config (README, Security).
CMD ["serve", "--out", "/data/map"]
