"""A plugin of pytest that notes which lines of some modules each test file executes.

Lines that only threads of the compiler or other processes execute are not seen. A kernel that is
compiled already is not executed again, so a line may have more files than are noted. Of a
function's many calls only the first ones in each file are followed, as that takes long.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections import Counter, defaultdict
from pathlib import Path
from types import CodeType

CALLS = 30
FOLDER, NOTED = "PCM_LINES_OF", "PCM_LINES_NOTED"
_lines: dict[tuple[str, int], set[str]] = defaultdict(set)
_calls: Counter[tuple[CodeType, str]] = Counter()
_current = [""]


def _within(frame, event, _):
    if event == "line":
        _lines[frame.f_code.co_filename, frame.f_lineno].add(_current[0])
    return _within


def _called(frame, event, _):
    code = frame.f_code
    if not code.co_filename.startswith(os.environ[FOLDER]):
        return None
    _calls[code, _current[0]] += 1
    return _within(frame, "line", None) if _calls[code, _current[0]] <= CALLS else None


def pytest_collection():
    sys.settrace(_called)
    threading.settrace(_called)


def pytest_runtest_protocol(item):
    _current[0] = str(item.path)


def pytest_sessionfinish():
    sys.settrace(None)
    threading.settrace(None)  # pyright: ignore[reportArgumentType]
    noted = [[file, line, sorted(tests)] for (file, line), tests in sorted(_lines.items())]
    Path(os.environ[NOTED]).write_text(json.dumps(noted))
