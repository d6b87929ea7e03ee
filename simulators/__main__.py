"""A vehicle of fake devices on loopback ports and terminals, driving through a world until stopped.

python -m simulators --world office --print-endpoints --truth truth.txt
"""

import sys

from service.compile.cache import ensure_cache_dir

if __name__ == "__main__":
    ensure_cache_dir()  # before anything imports numba
    from simulators.run import main

    sys.exit(main())
