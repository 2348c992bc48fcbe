# shellcheck shell=bash disable=SC2034,SC2154
# Sourced by setup.sh: builds the newest PETSc, petsc4py and a parallel h5py into the environment $venv, in about ten
# minutes. The functions pip_install and failed are setup.sh's.
#
# MUMPS, ScaLAPACK and PT-Scotch are the distribution's; its hypre is too old for a new PETSc, and GAMG takes its place.
# PFEM_PETSC_VERSION chooses another version, PFEM_BUILD_JOBS the number of compilers at once.

build_packages=(gcc g++ gfortran make patchelf python3-dev python3-venv openmpi-bin libopenmpi-dev libopenblas-dev
    libmumps-dev libscalapack-openmpi-dev libptscotch-dev libhdf5-openmpi-dev)

petsc_options() {
    local library name
    library=/usr/lib/$(gcc -print-multiarch)
    paths() {
        local joined=""
        for name in "$@"; do joined+="${joined:+,}$library/lib$name.so"; done
        printf '[%s]' "$joined"
    }
    printf '%s ' --with-debugging=0 --with-cuda=0 --with-cudac=0 --with-fortran-bindings=0 --with-x=0 \
        "--with-make-np=$jobs" COPTFLAGS=-O3 CXXOPTFLAGS=-O3 FOPTFLAGS=-O3 \
        "--with-blaslapack-lib=$library/libopenblas.so" \
        --with-scalapack=1 "--with-scalapack-lib=$(paths scalapack-openmpi)" \
        --with-ptscotch=1 --with-ptscotch-include=/usr/include/scotch \
        "--with-ptscotch-lib=$(paths ptesmumps ptscotch ptscotcherr esmumps scotch scotcherr)" \
        --with-mumps=1 --with-mumps-include=/usr/include \
        "--with-mumps-lib=$(paths smumps dmumps cmumps zmumps mumps_common pord)"
}

build_petsc() {
    local version=${PFEM_PETSC_VERSION:+==$PFEM_PETSC_VERSION} hdf5 python=$venv/bin/python
    # nproc would tell OMP_NUM_THREADS.
    local jobs=${PFEM_BUILD_JOBS:-$(env -u OMP_NUM_THREADS nproc)}
    if "$python" -c "import petsc4py.PETSc, h5py, sys; sys.exit(not h5py.get_config().mpi)" 2>/dev/null; then
        return
    fi
    # These would make the build use another PETSc than its own.
    unset PETSC_DIR PETSC_ARCH PYTHONPATH
    pip_install --upgrade pip setuptools wheel cython numpy pkgconfig
    # The wheel finds the machine's MPI at run time; the same package from source takes ten minutes.
    pip_install --only-binary=mpi4py mpi4py

    # No wheel from pip's cache: it holds the paths of the environment that it was built in.
    echo "setup: building PETSc with $jobs job(s); its log: $venv/petsc.log"
    PATH=$venv/bin:$PATH PETSC_CONFIGURE_OPTIONS=$(petsc_options) MAKEFLAGS=-j$jobs \
        "$python" -m pip install --verbose --no-cache-dir --no-build-isolation --no-deps "petsc$version" > "$venv/petsc.log" 2>&1 ||
        failed "$venv/petsc.log"
    echo "setup: building petsc4py"
    PETSC_DIR=$("$python" -c "import petsc; print(petsc.get_petsc_dir())") MAKEFLAGS=-j$jobs \
        "$python" -m pip install --verbose --no-cache-dir --no-build-isolation --no-deps \
        "petsc4py==$("$python" -c "from importlib.metadata import version; print(version('petsc'))")" \
        > "$venv/petsc4py.log" 2>&1 || failed "$venv/petsc4py.log"
    echo "setup: building h5py on the parallel HDF5"
    hdf5=/usr/lib/$(gcc -print-multiarch)/hdf5/openmpi
    # Without isolation, or an old mpi4py is compiled first for the sake of its headers.
    HDF5_MPI=ON CC=mpicc HDF5_DIR=$hdf5 \
        "$python" -m pip install --verbose --no-cache-dir --no-build-isolation --no-deps --no-binary=h5py h5py \
        > "$venv/h5py.log" 2>&1 || failed "$venv/h5py.log"
}
