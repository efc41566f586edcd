"""The SCas4D method as a library of array functions, without HTTP and without process management."""

import os

# OpenMP reads this variable once, when the first library that uses it (torch, scikit-learn, Numba) is loaded. Waiting
# threads must sleep: spinning threads slow everything down severalfold when another process needs their core.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
