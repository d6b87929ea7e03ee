"""How kernels become machine code and where that is kept.

lazy        njit of the decorators: imports numba with the first call of a kernel
signatures  numba types of the declarations beside the kernels; which kernels a process calls
warm_up     compiles them before the first scan, one process per core, or loads them from the cache
worker      a process that compiles, and those of seldom kernels after the start
cache       the folder of compiled kernels
"""
