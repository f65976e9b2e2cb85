"""``python -m ssmpipe.cli``."""

from ssmpipe.cli import main

if __name__ == "__main__":
    main()
