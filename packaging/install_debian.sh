#!/bin/sh
# Installs the program with PETSc, MPI and HDF5 of Debian 12 (or a newer Debian or Ubuntu) into the environment /opt/pfem.
# The recipes for Docker and Apptainer run it; root runs it in a plain system: sh packaging/install_debian.sh SOURCE
set -eu
source=${1:-.}
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
apt-get install -qq --yes --no-install-recommends python3 python3-venv python3-mpi4py python3-h5py-mpi openmpi-bin \
    libopenblas0-pthread libosmesa6 ca-certificates
# python3-petsc4py-real3.18 and the like, in the newest version there is
petsc=$(apt-cache --names-only search '^python3-petsc4py-real[0-9.]+$' | awk '{print $1}' | sort -V | tail -n 1)
apt-get install -qq --yes --no-install-recommends "$petsc"
rm -rf /var/lib/apt/lists/*
python3 -m venv --system-site-packages /opt/pfem
site=$(/opt/pfem/bin/python -c "import sysconfig; print(sysconfig.get_path('purelib'))")
dpkg -L "$petsc" | grep '/dist-packages/petsc4py$' | xargs -n 1 dirname > "$site/petsc.pth"
# bindings compiled against NumPy 1 do not load with NumPy 2
limit=$(python3 -c "import numpy; print('numpy<2' if numpy.__version__.startswith('1.') else 'numpy')")
# What pyproject.toml lists, without what comes from the distribution: pip does not see Debian's parallel h5py, and would
# put a serial one before it.
/opt/pfem/bin/python - "$source" > /tmp/requirements.txt <<'PYTHON'
import pathlib, re, sys, tomllib
project = tomllib.loads(pathlib.Path(sys.argv[1], "pyproject.toml").read_text())["project"]
wanted = [*project["dependencies"], *project["optional-dependencies"]["mesh"]]
print(*(text for text in wanted if re.match(r"[\w-]+", text)[0] not in ("petsc4py", "mpi4py", "h5py")), sep="\n")
PYTHON
/opt/pfem/bin/pip install --no-cache-dir --disable-pip-version-check "$limit" -r /tmp/requirements.txt
/opt/pfem/bin/pip install --no-cache-dir --disable-pip-version-check --no-deps "$source"
rm /tmp/requirements.txt
