"""The SCas4D method as a library of array functions, without HTTP or process management."""

import os

# OpenMP reads this variable once, when the first library that uses OpenMP (torch, scikit-learn, Numba) is loaded.
# Waiting threads must sleep, because spinning threads cause severalfold slowdowns when another process needs their
# core.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
