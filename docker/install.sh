#!/bin/sh
# The steps that make a bare Debian 12 root a home of the server; run as root in the project's folder there.
#
#   sh docker/install.sh system              what Debian brings, and the user without rights
#   sh docker/install.sh driver nvidia|intel how OpenCL finds the GPU
#   sh docker/install.sh kuberay             what KubeRay's probes and start commands take for granted
#   sh docker/install.sh packages LOCK       Python's packages, by their hashes
#   sh docker/install.sh program             the program itself
set -eu

USER_ID=10001

install_debian() {
    export DEBIAN_FRONTEND=noninteractive
    apt-get update
    apt-get install --yes --no-install-recommends "$@"
    rm -rf /var/lib/apt/lists/*
}

system() {
    # The first three: PoCL links the kernels that it compiles with ld, against libgcc and libc, at run time.
    install_debian binutils libc6-dev libgcc-12-dev ca-certificates make python3 python3-venv tini
    # /data is the user's home: rooms, certificates and the kernel cache all end up in it.
    id probeless > /dev/null 2>&1 ||
        useradd --uid "$USER_ID" --home-dir /data --create-home --shell /usr/sbin/nologin probeless
}

driver() {
    case "$1" in
        nvidia)  # the container toolkit brings the driver's library, but not the file that names it
            mkdir -p /etc/OpenCL/vendors
            echo libnvidia-opencl.so.1 > /etc/OpenCL/vendors/nvidia.icd
            ;;
        intel) install_debian intel-opencl-icd ;;
        *) echo "install.sh: no driver for $1: choose nvidia or intel" >&2; exit 2 ;;
    esac
}

kuberay() {
    install_debian bash wget
    # It starts nodes from a login shell, whose PATH is Debian's own.
    ln -sf "$PWD/.venv/bin/ray" "$PWD/.venv/bin/serve" /usr/local/bin/
}

packages() {
    test -x .venv/bin/python || python3 -m venv .venv
    .venv/bin/pip install --quiet --disable-pip-version-check --no-cache-dir --require-hashes --requirement "$1"
}

program() {
    make install
    # The user may not write here, so what is compiled now is all that ever is.
    .venv/bin/python -m compileall -q protocol server client cl_kernels docker
}

case "${1:-}" in
    system | kuberay | program) "$1" ;;
    driver | packages) "$1" "${2:?what $1?}" ;;
    *) echo "install.sh: no step '${1:-}': choose system, driver, kuberay, packages or program" >&2; exit 2 ;;
esac
