"""`python -m illuminerf`, and so `torchrun -m illuminerf`."""

from illuminerf.entry import main

if __name__ == "__main__":
    main()
