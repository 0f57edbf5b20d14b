"""Figures and numbers of the paper that the model is from, made anew and compared with its claims.

Only commands stand above it.
"""
