#!/bin/sh
# Runs smsr in place of this shell, so that it is process 1 and gets the signals.
# BLAS makes its threads while it loads, one for each core of the host: here one for each core that
# the container may use, unless the environment says otherwise.
set -eu
if [ -z "${OMP_NUM_THREADS:-}" ]; then
  OMP_NUM_THREADS=$(python -c 'from worker.cgroup import available_cores; print(available_cores())')
fi
export OMP_NUM_THREADS OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-$OMP_NUM_THREADS}"
if [ "${1:-}" = worker ]; then
  # What `smsr worker` becomes once it has loaded all of the command line.
  shift
  exec python -m worker.main "$@"
fi
exec smsr "$@"
