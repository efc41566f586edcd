"""Bundles JavaScript modules into one classic script, for pages opened from ``file://``.

Browsers do not load modules from ``file://``. Each module therefore becomes a function that returns its exports. Only
the import and export forms matched by the patterns below are supported.
"""

from __future__ import annotations

import re
from pathlib import Path

_IMPORT = re.compile(r'^import \{([^}]*)\} from "(\.[^"]+)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const|var) +([\w$]+))", re.MULTILINE)
_LIST = re.compile(r"^export \{([^}]*)\};\n?", re.MULTILINE)
_OTHER = re.compile(r"^(?:import|export)\b.*", re.MULTILINE)


def script(entry: Path, root: Path) -> str:
    """Returns a script that contains a module and everything it imports.

    Args:
        entry: path to the entry module.
        root: folder that contains all modules. Modules are named by their path relative to this folder.

    Returns:
        Self-contained script that does not contain ``</script``.

    Raises:
        ValueError: if a module uses an unsupported form of import or export, or if imports are circular.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     root = Path(folder)
    ...     _ = (root / "b.js").write_text("export const one = 1;\\n")
    ...     _ = (root / "a.js").write_text('import { one } from "./b.js";\\nconsole.log(one);\\n')
    ...     print(script(root / "a.js", root))
    (() => {
    "use strict";
    const modules = {};
    modules["b.js"] = (() => {
    const one = 1;
    return { one };
    })();
    modules["a.js"] = (() => {
    const { one } = modules["b.js"];
    console.log(one);
    return {  };
    })();
    })();
    """
    linked: dict[Path, str] = {}
    _link(entry.resolve(), root.resolve(), linked, ())
    text = "\n".join(['(() => {\n"use strict";\nconst modules = {};', *linked.values(), "})();"])
    if "</script" in text.lower() or "<!--" in text:
        raise ValueError(f"{entry.name}: a module contains text that would end an HTML script element; split that text")
    return text


def _link(path: Path, root: Path, linked: dict[Path, str], within: tuple[Path, ...]) -> None:
    if path in linked:
        return
    if path in within:
        raise ValueError(f"circular import: {' → '.join(one.name for one in (*within, path))}")
    text = path.read_text(encoding="utf-8")
    exported = [match.group(1) for match in _EXPORT.finditer(text)]
    exported += [name.strip() for match in _LIST.finditer(text) for name in match.group(1).split(",") if name.strip()]

    def imported(match: re.Match[str]) -> str:
        target = (path.parent / match.group(2)).resolve()
        _link(target, root, linked, (*within, path))
        names = ", ".join(name.strip().replace(" as ", ": ") for name in match.group(1).split(",") if name.strip())
        return f"const {{ {names} }} = modules[{_quoted(target, root)}];\n"

    body = _LIST.sub("", _EXPORT.sub("", _IMPORT.sub(imported, text)))
    if other := _OTHER.search(body):
        raise ValueError(f"{path.name}: unsupported form of import or export: {other.group()!r}")
    returned = f"return {{ {', '.join(exported)} }};"
    linked[path] = f"modules[{_quoted(path, root)}] = (() => {{\n{body.rstrip()}\n{returned}\n}})();"


def _quoted(path: Path, root: Path) -> str:
    return f'"{path.relative_to(root).as_posix()}"'
