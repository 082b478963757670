"""Entry point of `python -m trustbo`, for use if the script `trustbo` is not on the path."""

from trustbo.cli import main

if __name__ == "__main__":
    main()
