"""Compiles the GPU kernels without a GPU, and reports the registers, stack and spills of each kernel."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from scas4d_core.engines.warp.compile_ahead import compile_ahead

ENTRY = re.compile(r"Compiling entry function '(\w+?)_[0-9a-f]{8}_cuda_kernel")
STACK = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
REGISTERS = re.compile(r"Used (\d+) registers")


@dataclass(frozen=True)
class KernelUse:
    """Resources that a kernel uses on one architecture.

    Attributes:
        name: kernel name.
        architecture: compute capability times 10.
        registers: registers per thread.
        stack: stack frame in bytes.
        spills: bytes written to and read from memory because registers ran out.
    """

    name: str
    architecture: int
    registers: int
    stack: int
    spills: int


def uses_of(ptxas: Path, file: Path, architecture: int) -> list[KernelUse]:
    """Assembles a PTX file and returns the resources of its kernels.

    Raises:
        RuntimeError: the file cannot be assembled, for example because ptxas is older than NVIDIA Warp's compiler.
    """
    with tempfile.NamedTemporaryFile(suffix=".ptx") as clean:
        clean.write(file.read_bytes().replace(b"\0", b""))  # Warp also writes the null terminator
        clean.flush()
        command = [str(ptxas), "-v", f"-arch=sm_{architecture}", "-o", "/dev/null", clean.name]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(
            f"ptxas: {done.stderr.strip().splitlines()[0]}; use a newer version (package nvidia-cuda-nvcc)"
        )
    return parse(done.stderr, architecture)


def parse(output: str, architecture: int) -> list[KernelUse]:
    """Returns the resources of each kernel in the verbose output of ptxas.

    >>> said = '''ptxas info : Compiling entry function 'shade_0123abcd_cuda_kernel_forward' for 'sm_90'
    ... 8 bytes stack frame, 4 bytes spill stores, 12 bytes spill loads
    ... ptxas info : Used 43 registers, used 0 barriers'''
    >>> parse(said, 90)
    [KernelUse(name='shade', architecture=90, registers=43, stack=8, spills=16)]
    """
    uses, name, stack, spills = [], "", 0, 0
    for line in output.splitlines():
        if entry := ENTRY.search(line):
            name = entry[1]
        elif frame := STACK.search(line):
            stack, spills = int(frame[1]), int(frame[2]) + int(frame[3])
        elif registers := REGISTERS.search(line):
            uses.append(KernelUse(name, architecture, int(registers[1]), stack, spills))
    return uses


def measure(architectures: Sequence[int], ptxas: Path | None) -> list[KernelUse]:
    """Compiles all kernels for each architecture and returns their resources, or an empty list without ptxas."""
    uses = []
    for architecture in architectures:
        with tempfile.TemporaryDirectory() as folder:
            for file in compile_ahead(architecture, Path(folder), ptx=ptxas is not None):
                if ptxas is not None:
                    uses += uses_of(ptxas, file, architecture)
    return uses


def find_ptxas() -> Path | None:
    """Returns the path of ptxas, or None if it was not found."""
    found = shutil.which("ptxas")
    return None if found is None else Path(found)


def table(uses: Sequence[KernelUse]) -> str:
    """Formats the resources as a Markdown table, with one row per kernel and one column per architecture.

    Each cell contains the registers per thread, and the spills in bytes if there are any.
    """
    architectures = sorted({use.architecture for use in uses})
    lines = [
        "| kernel | " + " | ".join(f"sm_{each}" for each in architectures) + " |",
        "|---" * (len(architectures) + 1) + "|",
    ]
    for name in sorted({use.name for use in uses}):
        own = {use.architecture: use for use in uses if use.name == name}
        cells = [
            f"{own[each].registers}" + (f" ({own[each].spills} B)" if own[each].spills else "")
            for each in architectures
        ]
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    return "\n".join(lines)
