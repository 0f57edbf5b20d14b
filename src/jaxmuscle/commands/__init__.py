"""The command line: each command reads its options, calls the public functions and writes files.

Nothing is computed here.
"""
