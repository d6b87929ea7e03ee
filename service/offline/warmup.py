"""Compiles the kernels ahead of time, so that the next start loads them from the cache."""

import os
import time

from service.encoding import warm_up as warm_up_encoding
from service.kernel_cache import KERNELS, mark_warm
from service.kernel_warm_up import KernelProgress
from service.kernel_warm_up import warm_up as warm_up_kernels
from service.mapper.profiles import MappingConfig


def warm_up(
    config: MappingConfig | None = None, progress: KernelProgress | None = None
) -> dict[str, float | str]:
    """Run every kernel once, or those that a config needs. How long it took, and where the code is kept."""
    began_s = time.monotonic()
    warm_up_encoding()
    warm_up_kernels(config, progress=progress)
    if config is None:
        mark_warm()
    return {
        "seconds": round(time.monotonic() - began_s, 3),
        "cache": os.environ.get("NUMBA_CACHE_DIR") or str(KERNELS / "__pycache__"),
    }
