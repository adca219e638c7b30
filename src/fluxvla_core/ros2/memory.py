"""Let the memory of one picture serve the next.

A picture is larger than what malloc keeps: each message, and each copy of one, would be asked of
the kernel and given back to it, page by page, which takes longer than copying the picture and stops
the process's other threads meanwhile. glibc keeps larger blocks when told to (mallopt(3)); other C
libraries are left as they are. Memory stays bounded by what was in use at one time.
"""

from __future__ import annotations

import ctypes
from functools import cache

# mallopt(3), <malloc.h>.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
# The largest that glibc takes (DEFAULT_MMAP_THRESHOLD_MAX on 64 bits).
_LARGEST = 32 << 20
_KEPT = 256 << 20


@cache
def keep_large_blocks() -> bool:
    """For the rest of the process; whether the C library can."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _LARGEST) and mallopt(_M_TRIM_THRESHOLD, _KEPT))
