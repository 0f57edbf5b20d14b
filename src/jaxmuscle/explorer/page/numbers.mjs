// Small dense linear algebra, Fourier transform and special functions. A matrix is an array of rows.

export const zeros = (rows, columns) => Array.from({ length: rows }, () => new Array(columns).fill(0));
export const eye = (n) => zeros(n, n).map((row, i) => ((row[i] = 1), row));
export const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
export const transpose = (A, columns = A[0]?.length ?? 0) =>
  Array.from({ length: columns }, (_, j) => A.map((row) => row[j]));
export const outer = (a, b) => a.map((x) => b.map((y) => x * y));
export const plus = (A, B) => A.map((row, i) => row.map((x, j) => x + B[i][j]));
export const scaledBy = (A, s) => A.map((row) => row.map((x) => s * x));
export const apply = (A, x) => A.map((row) => dot(row, x));

export function product(A, B) {
  const columns = B[0]?.length ?? 0;
  return A.map((row) => {
    const sum = new Array(columns).fill(0);
    row.forEach((x, k) => {
      if (x !== 0) for (let j = 0; j < columns; j++) sum[j] += x * B[k][j];
    });
    return sum;
  });
}

// X with A X = B, by Gauss with row pivots; B is a matrix.
export function solve(A, B) {
  const n = A.length,
    M = A.map((row, i) => [...row, ...B[i]]);
  for (let k = 0; k < n; k++) {
    let pivot = k;
    for (let i = k + 1; i < n; i++) if (Math.abs(M[i][k]) > Math.abs(M[pivot][k])) pivot = i;
    [M[k], M[pivot]] = [M[pivot], M[k]];
    for (let i = k + 1; i < n; i++) {
      const f = M[i][k] / M[k][k];
      if (f !== 0) for (let j = k; j < M[i].length; j++) M[i][j] -= f * M[k][j];
    }
  }
  for (let k = n - 1; k >= 0; k--) {
    for (let j = n; j < M[k].length; j++) {
      for (let i = k + 1; i < n; i++) M[k][j] -= M[k][i] * M[i][j];
      M[k][j] /= M[k][k];
    }
  }
  return M.map((row) => row.slice(n));
}

// exp(A): scaling by 2^s, the Padé approximant of degree 8, squaring.
export function expm(A) {
  const n = A.length;
  if (n === 0) return [];
  const size = Math.max(...A.map((row) => row.reduce((sum, x) => sum + Math.abs(x), 0)));
  const s = size > 0.5 ? Math.ceil(Math.log2(size / 0.5)) : 0;
  const X = scaledBy(A, 2 ** -s);
  let power = eye(n),
    above = eye(n),
    below = eye(n),
    c = 1;
  for (let k = 1; k <= 8; k++) {
    c *= (8 - k + 1) / (k * (16 - k + 1));
    power = product(X, power);
    above = plus(above, scaledBy(power, c));
    below = plus(below, scaledBy(power, k % 2 ? -c : c));
  }
  let E = solve(below, above);
  for (let k = 0; k < s; k++) E = product(E, E);
  return E;
}

// X with A X + X Fᵀ + Q = 0.
export function sylvester(A, F, Q) {
  const n = A.length,
    m = F.length;
  if (n === 0 || m === 0) return Q;
  const both = zeros(n * m, n * m),
    right = zeros(n * m, 1);
  for (let i = 0; i < n; i++) {
    for (let j = 0; j < m; j++) {
      for (let k = 0; k < n; k++) both[i * m + j][k * m + j] += A[i][k];
      for (let k = 0; k < m; k++) both[i * m + j][i * m + k] += F[j][k];
      right[i * m + j][0] = -Q[i][j];
    }
  }
  const x = solve(both, right);
  return Q.map((row, i) => row.map((_, j) => x[i * m + j][0]));
}

// [A B; C D]
export const blocks = (A, B, C, D) => [...A.map((row, i) => [...row, ...B[i]]), ...C.map((row, i) => [...row, ...D[i]])];

// Lower L with L Lᵀ = A; a diagonal that rounding made negative counts as zero.
export function cholesky(A) {
  const n = A.length,
    L = zeros(n, n);
  for (let i = 0; i < n; i++) {
    for (let j = 0; j <= i; j++) {
      const rest = A[i][j] - dot(L[i].slice(0, j), L[j].slice(0, j));
      L[i][j] = i === j ? Math.sqrt(Math.max(rest, 0)) : L[j][j] > 0 ? rest / L[j][j] : 0;
    }
  }
  return L;
}

// Eigenvalues (rising) and eigenvectors (rows) of a symmetric matrix, by Jacobi's rotations.
export function eigenOfSymmetric(S) {
  const n = S.length,
    A = S.map((row) => [...row]),
    V = eye(n);
  for (let sweep = 0; sweep < 60; sweep++) {
    let off = 0;
    for (let i = 0; i < n; i++) for (let j = 0; j < i; j++) off += A[i][j] ** 2;
    if (off < 1e-26 * A.reduce((sum, row, i) => sum + row[i] ** 2, 1e-300)) break;
    for (let p = 0; p < n; p++) {
      for (let q = p + 1; q < n; q++) {
        if (A[p][q] === 0) continue;
        const w = (A[q][q] - A[p][p]) / (2 * A[p][q]);
        const t = (w < 0 ? -1 : 1) / (Math.abs(w) + Math.hypot(1, w)),
          c = 1 / Math.hypot(1, t),
          s = t * c;
        for (const M of [A])
          for (let k = 0; k < n; k++) [M[k][p], M[k][q]] = [c * M[k][p] - s * M[k][q], s * M[k][p] + c * M[k][q]];
        for (const M of [A, V])
          for (let k = 0; k < n; k++) [M[p][k], M[q][k]] = [c * M[p][k] - s * M[q][k], s * M[p][k] + c * M[q][k]];
      }
    }
  }
  const order = A.map((_, i) => i).sort((i, j) => A[i][i] - A[j][j]);
  return { values: order.map((i) => A[i][i]), vectors: order.map((i) => V[i]) };
}

// In place: Σ (re + i im)_m exp(∓2πi k m / n), n a power of two; the inverse is not divided by n.
export function fourier(re, im, inverse = false) {
  const n = re.length;
  for (let i = 1, j = 0; i < n; i++) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [re[i], re[j]] = [re[j], re[i]];
      [im[i], im[j]] = [im[j], im[i]];
    }
  }
  for (let size = 2; size <= n; size *= 2) {
    const half = size / 2,
      angle = ((inverse ? 2 : -2) * Math.PI) / size;
    const c = Float64Array.from({ length: half }, (_, k) => Math.cos(angle * k));
    const s = Float64Array.from({ length: half }, (_, k) => Math.sin(angle * k));
    for (let start = 0; start < n; start += size) {
      for (let k = 0; k < half; k++) {
        const i = start + k,
          j = i + half;
        const x = re[j] * c[k] - im[j] * s[k],
          y = re[j] * s[k] + im[j] * c[k];
        re[j] = re[i] - x;
        im[j] = im[i] - y;
        re[i] += x;
        im[i] += y;
      }
    }
  }
}

// Σ_m x_{m+l} conj(x_m), real part, for the lags 0 ... count - 1.
export function autocorrelation(re, im, count) {
  let size = 1;
  while (size < re.length + count) size *= 2;
  const a = new Float64Array(size),
    b = new Float64Array(size);
  a.set(re);
  if (im) b.set(im);
  fourier(a, b);
  for (let k = 0; k < size; k++) {
    a[k] = a[k] ** 2 + b[k] ** 2;
    b[k] = 0;
  }
  fourier(a, b, true);
  return a.slice(0, count).map((x) => x / size);
}

// ψ and its first two derivatives' first: digamma and trigamma, by recurrence and the asymptotic series.
export function digamma(x) {
  let sum = 0;
  for (; x < 10; x++) sum -= 1 / x;
  const y = 1 / (x * x);
  return (
    sum +
    Math.log(x) -
    0.5 / x -
    y * (1 / 12 - y * (1 / 120 - y * (1 / 252 - y * (1 / 240 - y * (1 / 132 - (y * 691) / 32760)))))
  );
}

export function trigamma(x) {
  let sum = 0;
  for (; x < 10; x++) sum += 1 / (x * x);
  const y = 1 / (x * x);
  return (
    sum + 1 / x + y / 2 + (y / x) * (1 / 6 - y * (1 / 30 - y * (1 / 42 - y * (1 / 30 - y * (5 / 66 - (y * 691) / 2730)))))
  );
}

// The modified Bessel function I₀.
export function bessel0(x) {
  let term = 1,
    sum = 1;
  for (let k = 1; term > 1e-17 * sum; k++) {
    term *= (x / (2 * k)) ** 2;
    sum += term;
  }
  return sum;
}

// K, and sn / cn at u, of the complementary parameter m1 = 1 - m: arithmetic-geometric means, descending.
export function ellipticK(m1) {
  let a = 1,
    b = Math.sqrt(m1);
  while (Math.abs(a - b) > 1e-15 * a) [a, b] = [(a + b) / 2, Math.sqrt(a * b)];
  return Math.PI / (2 * a);
}

export function ellipticTangent(u, m1) {
  const a = [1],
    c = [Math.sqrt(1 - m1)];
  let b = Math.sqrt(m1);
  while (Math.abs(c[c.length - 1]) > 1e-16 * a[a.length - 1] && a.length < 40) {
    const last = a[a.length - 1];
    a.push((last + b) / 2);
    c.push((last - b) / 2);
    b = Math.sqrt(last * b);
  }
  let phi = 2 ** (a.length - 1) * a[a.length - 1] * u;
  for (let k = a.length - 1; k > 0; k--) phi = (phi + Math.asin((c[k] / a[k]) * Math.sin(phi))) / 2;
  return Math.tan(phi);
}

// Uniform numbers from a seed (a 32-bit mixing generator), and normals from pairs of them.
export function normals(seed) {
  let state = (seed * 2654435761) >>> 0,
    kept = null;
  const uniform = () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let t = Math.imul(state ^ (state >>> 15), 1 | state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return (((t ^ (t >>> 14)) >>> 0) + 0.5) / 4294967296;
  };
  return () => {
    if (kept !== null) {
      const z = kept;
      kept = null;
      return z;
    }
    const radius = Math.sqrt(-2 * Math.log(uniform())),
      angle = 2 * Math.PI * uniform();
    kept = radius * Math.sin(angle);
    return radius * Math.cos(angle);
  };
}
