#!/usr/bin/env bash
# Brings a machine to a working virtual environment in the checkout. Does nothing where that is done already; where it was
# stopped, or something is missing, it goes on with that.
#
# usage: scripts/setup.sh [--build-petsc] [--dev]
#
# --dev: also what tests, the site of the documentation and optional features need; an environment that has it keeps it
#
# Where PETSc comes from:
#   - PETSC_DIR is set, or the active Python imports petsc4py: that PETSc, with that Python; nothing is installed outside
#     the environment.
#   - otherwise Debian's or Ubuntu's packages (as root or through sudo), two to three minutes;
#   - --build-petsc: the newest release, built into an environment of its own, about ten minutes.
#
# PFEM_VENV   the environment; default .venv, with --build-petsc .venv-petsc
set -euo pipefail

build=no dev=no
for argument in "$@"; do
    case $argument in
        --build-petsc) build=yes ;;
        --dev) dev=yes ;;
        *) sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//;p}' "$0"; exit "$([[ $argument == --help ]] && echo 0 || echo 2)" ;;
    esac
done
if [[ $build == yes ]]; then
    export PFEM_VENV=${PFEM_VENV:-.venv-petsc}
fi
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
source "$root/scripts/build_petsc.sh"
cd "$root"

say() { echo "setup: $*"; }
fail() { echo "setup: $*" >&2; exit 1; }

# failed LOG COMMAND: the end of what a command said, and the cause if it is a usual one.
failed() {
    local cause
    cause=$(cause "$1")
    tail -n 40 "$1" >&2
    fail "failed${2:+: ${2:0:60}}${cause:+: $cause}; the end of its output is above"
}

# cause LOG: the usual cause that the output of a command tells, with its remedy; nothing for another one.
cause() {
    if grep -qF "No space left on device" "$1"; then
        echo "the disk is full: make room"
    elif grep -qE "Could not get lock|is held by process" "$1"; then
        echo "another program installs packages: wait until it has ended"
    elif grep -qiE -e "name resolution|could not resolve|new connection|network is unreachable|could not connect" \
        -e "connection (refused|reset|timed out|broken)|read timed out|proxyerror|sslerror|certificate verify failed" \
        "$1"; then
        echo "packages cannot be downloaded: check the network, and https_proxy or PIP_INDEX_URL where they are needed"
    elif grep -qE "Permission denied|Read-only file system" "$1"; then
        echo "nothing can be written there: change the permissions, or give another folder by PFEM_VENV"
    fi
}

# At the end, whatever it is: an environment that is not finished is named, and how to go on.
ended() {
    local status=$?
    rm -f "$log"
    [[ $status == 0 ]] ||
        echo "setup: the environment ${venv#"$root"/} is not finished: the same command goes on from there" >&2
}

# The active Python, unless it is one of the environments that this script makes, or the distribution's own package.
foreign_python() {
    local candidate
    candidate=$(command -v python3) || return 1
    "$candidate" - "$root" <<'PYTHON' || return 1
import os, sys
root = sys.argv[1]
if os.path.realpath(sys.prefix).startswith(os.path.realpath(root) + os.sep):
    sys.exit(1)
petsc = os.environ.get("PETSC_DIR")
if not petsc:
    try:
        import petsc4py
    except ImportError:
        sys.exit(1)
    petsc = petsc4py.__file__
sys.exit(os.path.realpath(petsc).startswith(("/usr/lib/petscdir/", "/usr/lib/python3/")))
PYTHON
    echo "$candidate"
}

# What the environment was made from: it is up to date where this is unchanged.
stamp() {
    cat pyproject.toml scripts/setup.sh scripts/build_petsc.sh
    foundation
    echo "dev: $dev"
}

# Whether everything that pyproject.toml lists is installed; a package whose installation was interrupted is not. Those of
# the distribution have no metadata.
complete() {
    { requirements petsc4py mpi4py h5py && echo pfem_petsc; } | "$python" -c '
import re, sys
from importlib import metadata
for line in sys.stdin:
    metadata.version(re.match(r"[\w-]+", line)[0])
import h5py, mpi4py
' 2>/dev/null
}

foundation() { echo "$root $mode $base ${PETSC_DIR:-} ${PETSC_ARCH:-} ${PFEM_PETSC_VERSION:-}"; }

as_root() {
    if [[ $(id -u) == 0 ]]; then
        "$@"
    elif command -v sudo >/dev/null; then
        sudo "$@"
    else
        fail "needs root or sudo for \"$*\": have that done, activate a Python with petsc4py, or set PETSC_DIR"
    fi
}

apt_get() {
    as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=300 "$@" > "$log" 2>&1 ||
        failed "$log" "apt-get $*"
}

# Packages of the distribution: those missing are installed.
apt_install() {
    local missing=() package
    for package in "$@"; do
        dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q "ok installed" || missing+=("$package")
    done
    [[ ${#missing[@]} -gt 0 ]] || return 0
    say "installing ${missing[*]}"
    [[ $updated == yes ]] || apt_get update
    apt_get install --yes --no-install-recommends "${missing[@]}"
}

available() { apt-cache show "$1" >/dev/null 2>&1; }

# Pictures are drawn without a display by OSMesa or EGL; newer distributions have the second alone.
drawing_packages() {
    if ldconfig -p | grep -qE 'libOSMesa|libEGL\.so'; then
        return
    elif available libosmesa6; then
        printf '%s\n' libosmesa6
    else
        printf '%s\n' libegl1 libgl1-mesa-dri
    fi
}

# python3-petsc4py-real3.18 and the like: the real, 32-bit-index build in its newest version.
petsc_package() {
    apt-cache --names-only search '^python3-petsc4py-real[0-9.]+$' | awk '{print $1}' | sort -V | tail -n 1
}

# SLEPc for modes of large models, of the same build as PETSc; optional: where it is missing, or cannot be installed,
# smaller models are solved without.
slepc_package() {
    local package=${1/petsc4py/slepc4py}
    if apt-cache show "$package" >/dev/null 2>&1; then echo "$package"; fi
}

# An environment that stands on another Python or PETSc than asked for is made anew, one that was left half made is
# completed, and one of this script whose pip is beyond that is made anew.
make_venv() {
    local made_from
    made_from=$(cat "$venv/made-from" 2>/dev/null || foundation)
    if [[ ${made_from%% *} != "$root" && $(realpath -m "$venv") != "$root"/* && -d ${made_from%% *} ]]; then
        fail "$venv belongs to the checkout ${made_from%% *}: give PFEM_VENV another folder, or unset it"
    fi
    rm -f "$venv/setup-done"
    if ! "$python" -c "" 2>/dev/null || [[ $made_from != "$(foundation)" ]]; then
        say "making ${venv#"$root"/} with $1"
        run_venv --clear "$@"
    elif ! usable; then
        say "completing ${venv#"$root"/}, whose making was interrupted"
        run_venv "" "$@"
    fi
    if ! usable; then
        [[ -f $venv/made-from ]] || fail "pip does not work in $venv, which this script has not made: give PFEM_VENV" \
            "another folder"
        say "making ${venv#"$root"/} anew, because its pip does not work"
        run_venv --clear "$@"
    fi
    foundation > "$venv/made-from"
}

# run_venv --clear|"" PYTHON OPTIONS...
run_venv() {
    "$2" -m venv ${1:+"$1"} "${@:3}" "$venv" > "$log" 2>&1 || failed "$log" "$2 -m venv $venv"
}

usable() { [[ -f $venv/bin/activate ]] && "$python" -m pip --version > /dev/null 2>&1; }

site_packages() { "$python" -c "import sysconfig; print(sysconfig.get_path('purelib'))"; }

# What pyproject.toml lists, but for the packages named: those come with MPI and PETSc. Of the extras, users get those
# for meshes, and --dev all.
requirements() {
    "$python" - "$dev" "$@" <<'PYTHON'
import re, sys, tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
extras = project["optional-dependencies"]
chosen = extras if sys.argv[1] == "yes" else ["mesh"]
for line in [*project["dependencies"], *(r for name in chosen for r in extras[name])]:
    below = re.search(r"; python_version < '(\d+)\.(\d+)'", line)
    serves = below is None or sys.version_info < tuple(map(int, below.groups()))
    if serves and re.match(r"[\w-]+", line)[0] not in sys.argv[2:]:
        print(line)
PYTHON
}

pip_run() { "$python" -m pip --disable-pip-version-check "$@" > "$log" 2>&1 || failed "$log" "pip $*"; }

# Byte code is written where a package is imported, by the check and the first runs: that of all modules takes as much
# room as the largest of them.
unset PYTHONDONTWRITEBYTECODE
pip_install() { pip_run install --no-compile "$@"; }

# Packages that a user installs later must not bring a NumPy with which petsc4py does not work.
limit_numpy() {
    rm -f "$venv/pip.conf"
    if [[ $1 == *"<"* && $venv != *[[:space:]]* ]]; then
        echo "$1" > "$venv/constraints.txt"
        printf '[install]\nconstraint = %s\n' "$venv/constraints.txt" > "$venv/pip.conf"
    fi
}

install_rest() {
    local list
    limit_numpy "$1"
    mapfile -t list < <(requirements petsc4py mpi4py h5py)
    say "installing Python packages"
    pip_install "$@" "${list[@]}"
    pip_install --no-deps --editable .
    # venv brings it for builds, which have their own
    [[ ! -d $(site_packages)/setuptools ]] || pip_run uninstall --yes setuptools
}

# Compiled against NumPy 1, a package does not work with NumPy 2; the other way round it does.
numpy_limit() { "$1" -c "import numpy; print('numpy<2' if numpy.__version__.startswith('1.') else 'numpy')"; }

need_python() {
    "$1" -c "import sys; sys.exit(sys.version_info < (3, 11))" ||
        fail "needs Python 3.11 or newer, and $1 is $("$1" --version): a newer distribution, conda, or any newer Python" \
            "with petsc4py that is active serves"
}

from_distribution() {
    [[ ! -x /usr/bin/python3 ]] || need_python /usr/bin/python3
    command -v apt-get >/dev/null || fail "no apt-get here: activate a Python with petsc4py, or set PETSC_DIR"
    local package slepc drawing updated=no
    package=$(petsc_package)
    if [[ -z $package ]]; then
        apt_get update
        updated=yes
        package=$(petsc_package)
    fi
    [[ -n $package ]] || fail "no package python3-petsc4py-real here: activate a Python with petsc4py, set PETSC_DIR," \
        "or use --build-petsc"
    mapfile -t drawing < <(drawing_packages)
    slepc=$(slepc_package "$package")
    apt_install "$package" ${slepc:+"$slepc"} python3-mpi4py python3-h5py-mpi openmpi-bin python3-venv \
        libopenblas0-pthread "${drawing[@]}"
    need_python /usr/bin/python3
    make_venv /usr/bin/python3 --system-site-packages
    dpkg -L "$package" ${slepc:+"$slepc"} | grep -E '/dist-packages/(petsc4py|slepc4py)$' | xargs -n 1 dirname \
        > "$(site_packages)/petsc.pth"
    install_rest "$(numpy_limit /usr/bin/python3)"
}

from_source() {
    if command -v apt-get >/dev/null; then
        local drawing updated=no
        mapfile -t drawing < <(drawing_packages)
        apt_install "${build_packages[@]}" "${drawing[@]}"
    fi
    need_python "$base"
    make_venv "$base"
    build_petsc
    install_rest numpy
}

# An environment on top of the active Python: it sees that one's packages, and adds what is missing.
from_active() {
    local folder
    need_python "$base"
    make_venv "$base" --system-site-packages
    {
        "$base" -c "import sysconfig; print(*sorted({sysconfig.get_path(p) for p in ('purelib', 'platlib')}), sep='\n')"
        if [[ -n ${PETSC_DIR:-} ]]; then
            for folder in "$PETSC_DIR/${PETSC_ARCH:-}/lib" "$PETSC_DIR/lib" "$PETSC_DIR/lib/python3/dist-packages"; do
                if [[ -d $folder/petsc4py ]]; then echo "$folder"; fi
            done
        fi
    } > "$(site_packages)/petsc.pth"
    has() { "$python" -c "import $1" 2>/dev/null; }
    has numpy || pip_install numpy
    has mpi4py || pip_install mpi4py
    if ! has petsc4py; then
        local version
        version=$(awk '$2 == "PETSC_VERSION_MAJOR" {a = $3} $2 == "PETSC_VERSION_MINOR" {b = $3} END {print a "." b}' \
            "$PETSC_DIR/include/petscversion.h")
        say "building petsc4py for the PETSc $version in $PETSC_DIR"
        pip_install --no-cache-dir "petsc4py==$version.*"
    fi
    # Bindings that were compiled against NumPy 1 do not load with NumPy 2.
    has petsc4py.PETSc || pip_install "numpy<2"
    if ! has h5py; then
        if [[ -n ${HDF5_DIR:-} ]]; then
            say "building h5py on the HDF5 in $HDF5_DIR"
            pip_install cython pkgconfig setuptools wheel
            HDF5_MPI=ON CC=mpicc pip_install --no-cache-dir --no-build-isolation --no-deps \
                --no-binary=h5py h5py
        else
            pip_install h5py
        fi
    fi
    "$python" -c "import h5py, sys; sys.exit(not h5py.get_config().mpi)" ||
        say "this h5py is not the parallel build: runs on one rank work, on several they do not." \
            "Set HDF5_DIR to a parallel HDF5 and remove h5py from the active Python"
    install_rest "$(numpy_limit "$python")"
}

# What a run needs, on two ranks: PETSc and mpi4py of one MPI.
check() {
    on_ranks 2 600 "$python" -c '
from mpi4py import MPI
import petsc4py; petsc4py.init()
from petsc4py import PETSc
import h5py, numba, numpy, scipy, pydantic, pyvista, rich, matplotlib, imageio_ffmpeg
assert MPI.COMM_WORLD.size == PETSc.COMM_WORLD.size == 2, "PETSc and mpi4py do not share one MPI"
assert PETSc.ScalarType is numpy.float64, "PETSc has complex or single-precision numbers: a real, double build is needed"
if MPI.COMM_WORLD.rank == 0:
    petsc = ".".join(map(str, PETSc.Sys.getVersion()))
    print(f"setup: PETSc {petsc}, numpy {numpy.__version__}, h5py {h5py.__version__} (parallel: {h5py.get_config().mpi})")
' > "$log" 2>&1 || failed "$log" "mpirun -n 2 $python"
    grep "^setup:" "$log"
}

# One set-up at a time in a checkout.
exec 9< "$root/scripts/setup.sh"
if ! flock --nonblock 9; then
    say "waiting for another set-up of this checkout"
    flock 9
fi

log=$(mktemp)
trap ended EXIT
for signal in HUP INT TERM; do
    # shellcheck disable=SC2064
    trap "fail stopped by SIG$signal" "$signal"
done
if [[ $build == yes ]]; then
    mode=build base=$(command -v /usr/bin/python3 || command -v python3)
elif base=$(foreign_python); then
    mode=active
else
    mode=distribution base=/usr/bin/python3
fi
[[ ! -f $venv/for-development ]] || dev=yes
if [[ -x $python && -f $venv/setup-done ]] && stamp | cmp -s - "$venv/setup-done" && complete; then
    exit 0
fi
start=$SECONDS
case $mode in
    build) from_source ;;
    active) say "using $base and its PETSc"; from_active ;;
    distribution) from_distribution ;;
esac
check
compile_loops() {
    local folder
    folder=$(mktemp -d)
    "$python" -m compileall -q pfem_petsc
    on_ranks 2 3600 "$python" -m pfem_petsc bench --compile &&
        "$python" -m pfem_petsc rod_impact -o "$folder/rod" --set time.end=0.7 | what_is_compiled &&
        "$python" -m pfem_petsc lattice_drop -o "$folder/drop" | what_is_compiled &&
        on_ranks 2 3600 "$python" -m pfem_petsc lattice_drop -o "$folder/ranks" --set time.end=1e-5 | what_is_compiled &&
        "$python" -m pfem_petsc hanging_net -o "$folder/net" | what_is_compiled &&
        "$python" -m pfem_petsc render "$folder/rod" --frames 2 --video none > /dev/null
    local status=$?
    rm -rf "$folder"
    return $status
}
# Of what a run says.
what_is_compiled() { sed -n '/^compiling/p'; }
say "compiling loops for this machine, which runs load then; what takes long is told"
compile_loops || say "not all loops are compiled, for the reason above: the first runs compile what they need"
[[ $dev == no ]] || touch "$venv/for-development"
stamp > "$venv/setup-done"
say "done in $((SECONDS - start)) s: ${venv#"$root"/}"
