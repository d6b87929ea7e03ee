"""`python -m service`: the same as `corridor`."""

from service.command import main

if __name__ == "__main__":
    main()
