# The server on a CPU, through PoCL. From the project's folder: docker build -f docker/cpu.Dockerfile -t probeless:cpu .
FROM debian:bookworm-slim@sha256:96e378d7e6531ac9a15ad505478fcc2e69f371b10f5cdf87857c4b8188404716
WORKDIR /opt/probeless
COPY docker/install.sh docker/
RUN sh docker/install.sh system
COPY requirements.lock ./
RUN sh docker/install.sh packages requirements.lock
COPY LICENSE Makefile README.md pyproject.toml requirements.lock ./
COPY cl_kernels cl_kernels
COPY client client
COPY docker docker
COPY protocol protocol
COPY server server
RUN sh docker/install.sh program
# Memory in pages of 2 MB, which kernels miss less often in the processor's tables: frames take 3 % less (docs/operating.md).
ENV HOME=/data PYTHONUNBUFFERED=1 GLIBC_TUNABLES=glibc.malloc.hugetlb=1
VOLUME /data
USER 10001:10001
EXPOSE 8080
STOPSIGNAL SIGTERM
HEALTHCHECK --start-period=3m --interval=10s --timeout=6s --retries=3 CMD ["/opt/probeless/.venv/bin/python", "docker/health.py"]
ENTRYPOINT ["/usr/bin/tini", "--", "sh", "docker/start.sh"]
