"""The SCas4D method as a library of array functions, without HTTP or process management."""

import os

# OpenMP reads this variable once, when the first library that uses OpenMP (torch, scikit-learn, Numba) is loaded.
# Waiting threads must sleep, because spinning threads cause severalfold slowdowns when another process needs their
# core.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# Waking a sleeping thread takes about 50 µs on virtual machines. With GNU's runtime, threads therefore first spin for
# a few microseconds, which catches the next parallel region of an iteration. On two idle cores, updates become 4%
# faster (2026-11-30); 5000 instead of 1000 turns make them 10% faster, but 20% slower beside a busy process.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")
