"""``python -m ssmpipe``."""

from ssmpipe.cli import main

if __name__ == "__main__":
    main()
