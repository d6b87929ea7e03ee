"""`python -m service`: the same as `corridor`."""

from service.command import main

main()
