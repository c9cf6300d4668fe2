# probeless on an NVIDIA GPU. Needs the NVIDIA container toolkit on the host, which brings libnvidia-opencl but no ICD file.
FROM python:3.11-slim-bookworm
RUN apt-get update && apt-get install --yes --no-install-recommends make && rm -rf /var/lib/apt/lists/* \
    && mkdir -p /etc/OpenCL/vendors && echo libnvidia-opencl.so.1 > /etc/OpenCL/vendors/nvidia.icd
ENV NVIDIA_DRIVER_CAPABILITIES=compute,utility
WORKDIR /opt/probeless
COPY . .
RUN make install && useradd --create-home probeless
USER probeless
EXPOSE 8080
HEALTHCHECK CMD [".venv/bin/python", "-c", "import urllib.request as u; u.urlopen('http://127.0.0.1:8080/healthz')"]
CMD [".venv/bin/probeless", "serve", "--host", "0.0.0.0", "--port", "8080"]
