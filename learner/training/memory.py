"""How the C library's allocator treats the large arrays of training."""

from __future__ import annotations

import ctypes
from typing import Final

# Parameters of mallopt(3), from malloc.h of the GNU C library.
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
_LARGE_BYTES: Final = 2**30


def keep_freed_memory() -> None:
    """Let this process keep the memory that it frees, instead of giving it back to the system.

    Every minibatch allocates arrays of some hundred megabytes and frees them again. By default the
    system hands them out anew each time, page by page, all zeroed: that took 40 % of the time of
    pre-training. The process keeps its peak of memory instead. C libraries other than GNU's are
    left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _LARGE_BYTES)
