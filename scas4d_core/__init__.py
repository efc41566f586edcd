"""The SCas4D method as a library of array functions, without HTTP or process management."""

import os

# OpenMP reads these variables once, when the first library that uses OpenMP (torch, scikit-learn, Numba) is loaded.
# Threads that spin while they wait cause severalfold slowdowns when another process needs their core, so they sleep.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# Waking a sleeping thread takes about 50 µs on a virtual machine. With GNU's runtime, threads therefore spin for some
# microseconds before they sleep, because the next parallel region of an iteration often follows so soon. On two cores,
# updates of robot become 4% faster, and up to 4% slower beside a busy process; with 5000 instead of 1000 spins, 10%
# faster, and 20% slower (AMD EPYC, 2026-11-30).
os.environ.setdefault("GOMP_SPINCOUNT", "1000")
