"""Record which functions of this repository a process runs; see `scripts/closure.py`.

Python imports this module at its start, as its folder is in PYTHONPATH, also in the processes that
a command starts. Each function is noted when it is called for the first time.
"""

import os
import sys
from types import CodeType

_FILE = os.environ.get("TRUSTBO_CLOSURE")
_ROOT = os.environ.get("TRUSTBO_ROOT", "") + os.sep
_TOOL = sys.monitoring.PROFILER_ID

if _FILE:
    _output = os.open(_FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def _note(code: CodeType, offset: int) -> object:
        """Write the file and name of a function, and ask not to be called for it again."""
        if code.co_filename.startswith(_ROOT):
            name = code.co_filename.removeprefix(_ROOT)
            os.write(_output, f"{name}::{code.co_qualname}\n".encode())
        return sys.monitoring.DISABLE

    sys.monitoring.use_tool_id(_TOOL, "closure")
    sys.monitoring.set_events(_TOOL, sys.monitoring.events.PY_START)
    sys.monitoring.register_callback(_TOOL, sys.monitoring.events.PY_START, _note)
