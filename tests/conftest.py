"""Tests share scenes: this folder is on the path."""

import os
import sys
from pathlib import Path

# Before torch loads OpenMP, which reads it once: threads that spin while they wait cost multiples on busy cores.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
sys.path.insert(0, str(Path(__file__).parent))
