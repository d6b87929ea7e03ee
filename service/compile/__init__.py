"""How kernels become machine code and where that is kept.

lazy        the decorators' njit: imports numba with the first call of a kernel
signatures  the types that are declared beside each kernel, as numba's; which kernels a process calls
warm_up     compiles them before the first scan, by one process per core, or loads them from the cache
seldom      those that not every scan calls: after the start, by a process of the lowest priority
worker      such a process
cache       the folder in which numba keeps what it has compiled
"""
