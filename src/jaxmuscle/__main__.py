"""`python -m jaxmuscle` is the command `jaxmuscle`."""

from jaxmuscle.commands.main import main

if __name__ == "__main__":
    main()
