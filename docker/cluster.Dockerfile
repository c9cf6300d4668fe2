# A node of the cluster, head or worker: the server and Ray Serve. KubeRay starts its pods by commands of its own; what a
# container runs by itself is a cluster of two nodes to try.
# From the project's folder: docker build -f docker/cluster.Dockerfile -t probeless:cluster .
FROM debian:bookworm-slim@sha256:96e378d7e6531ac9a15ad505478fcc2e69f371b10f5cdf87857c4b8188404716
ARG VENDOR=nvidia
WORKDIR /opt/probeless
COPY docker/install.sh docker/
RUN sh docker/install.sh system
RUN sh docker/install.sh driver $VENDOR
RUN sh docker/install.sh kuberay
COPY requirements-cluster.lock ./
RUN sh docker/install.sh packages requirements-cluster.lock
COPY LICENSE Makefile README.md pyproject.toml requirements.lock ./
COPY cl_kernels cl_kernels
COPY client client
COPY docker docker
COPY protocol protocol
COPY server server
RUN sh docker/install.sh program
ENV HOME=/data PYTHONUNBUFFERED=1 RAY_SERVE_ENABLE_HA_PROXY=1 RAY_USAGE_STATS_ENABLED=0 PATH=/opt/probeless/.venv/bin:/usr/local/bin:/usr/bin:/bin
ENV PROBELESS_PORT=8000 NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
VOLUME /data
USER 10001:10001
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --start-period=5m --interval=10s --timeout=6s --retries=3 CMD ["/opt/probeless/.venv/bin/python", "docker/health.py"]
ENTRYPOINT ["/usr/bin/tini", "--", "sh", "docker/cluster/local.sh"]
