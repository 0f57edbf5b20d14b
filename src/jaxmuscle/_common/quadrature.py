"""Gauss-Legendre quadrature from 0 to 1, exact for polynomials up to degree 15."""

import numpy as np

_nodes, _weights = np.polynomial.legendre.leggauss(8)
NODES, WEIGHTS = 0.5 * (1 + _nodes), 0.5 * _weights
