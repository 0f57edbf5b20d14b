"""How programs of laboratories write recordings, one file for each; `_dialects` lists them.

Light to import: the process that reads files apart needs it, too.
"""
