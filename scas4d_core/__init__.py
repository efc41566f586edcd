"""The SCas4D method: arrays in, arrays out; no HTTP, no processes."""

import os

# OpenMP reads this once, when the first library that uses it (torch, scikit-learn, Numba) loads it. Waiting threads
# must sleep: spinning ones cost multiples as soon as anything else wants their core.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
