"""Description of the machine and the source version that produced a figure."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import scas4d_core
from scas4d_core.machine import usable_cores

CPU_INFO = Path("/proc/cpuinfo")
"""File from which the processor name is read on Linux. Elsewhere, the name comes from ``platform``."""


def machine() -> dict[str, Any]:
    """Returns a description of the machine (hardware, operating system, Python version) for a row of results."""
    cores = usable_cores()
    facts: dict[str, Any] = {"processor": processor(), "cores": cores}
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        facts["memory_gb"] = round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9, 1)
    return facts | {"system": platform.system(), "python": platform.python_version()}


def in_words(of: Mapping[str, Any]) -> str:
    """Formats the result of ``machine`` as one line, omitting unknown values."""
    words = [str(of.get("processor", "unknown processor"))]
    if "cores" in of:
        words.append(f"{of['cores']} core{'s' if of['cores'] != 1 else ''}")
    if "threads" in of:
        words.append(f"{of['threads']} thread{'s' if of['threads'] != 1 else ''} used")
    if "memory_gb" in of:
        words.append(f"{of['memory_gb']:g} GB RAM")
    words += [str(of["system"])] if "system" in of else []
    words += [f"Python {of['python']}"] if "python" in of else []
    return ", ".join(words)


def provenance(rows: Iterable[Mapping[str, Any]]) -> tuple[str, str, str]:
    """Returns the range of days, the machines and the source versions of rows, as text; dashes if there are none."""
    known = list(rows)
    days = sorted({str(row["measured"])[:10] for row in known if "measured" in row})
    machines = sorted({in_words(row["machine"]) for row in known if "machine" in row})
    cores = sorted({str(row["core"]) for row in known if "core" in row})
    when = " to ".join(dict.fromkeys((days[0], days[-1]))) if days else "–"
    return when, "; ".join(machines) or "–", ", ".join(cores) or "–"


def processor() -> str:
    """Returns the name of the processor, or its architecture if the name is unknown."""
    if CPU_INFO.exists():
        for line in CPU_INFO.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def browser_path() -> str | None:
    """Returns the path of Chromium, or of Chrome; None if neither is installed."""
    return os.environ.get("SCAS4D_TEST_BROWSER") or shutil.which("chromium") or shutil.which("google-chrome")


def core_version() -> str:
    """Returns eight hexadecimal digits that identify the sources of the method (all of ``scas4d_core``).

    Rows are identified by their settings. This version shows which of them were produced by the same code.
    """
    root = Path(scas4d_core.__file__).parent
    hasher = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        hasher.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return hasher.hexdigest()[:8]
