"""`python -m illuminerf`, and so `torchrun -m illuminerf`."""

from illuminerf.cli import main

if __name__ == "__main__":
    main()
