// How a spectrum is estimated: tapers, bins, low-pass, the filter against aliases. As jaxmuscle.SpectrumSettings says.
import { autocorrelation, bessel0, dot } from "./numbers.mjs";

export const REACH = 10,
  FINER = 8,
  TAIL = 1e-13;
export const WINDOW = [5, 15];

const kept = new Map();
function once(what, settings, make) {
  const key = what + JSON.stringify(settings);
  if (!kept.has(key)) {
    if (kept.size > 60) kept.clear();
    kept.set(key, make());
  }
  return kept.get(key);
}

export const frequencies = (s) =>
  Array.from({ length: s.last_bin - s.first_bin + 1 }, (_, k) => ((s.first_bin + k) * s.rate) / s.length);
export const stepOf = (s) => Math.max(s.length - Math.floor(s.overlap * s.length + 1e-9), 1);
export const segmentsIn = (s, samples) => Math.max(Math.floor((samples - s.length) / stepOf(s)) + 1, 0);
export const samplesIn = (s, [start, stop] = WINDOW) => Math.round(stop * s.rate) - Math.round(start * s.rate);

// Tapers, one a row; all squares sum to 1.
export function tapersOf(s) {
  return once("tapers", s, () => {
    const n = s.length,
      a = { hann: 0.5, hamming: 0.54, boxcar: 1 }[s.window];
    const rows =
      s.window === "dpss"
        ? slepian(n, (s.tapers + 1) / 2, s.tapers)
        : [Array.from({ length: n }, (_, m) => a + (1 - a) * Math.cos(Math.PI * ((2 * m) / n - 1)))];
    const size = Math.sqrt(rows.reduce((sum, row) => sum + dot(row, row), 0));
    return rows.map((row) => row.map((x) => x / size));
  });
}

// The first Slepian sequences: eigenvectors of a tridiagonal matrix, by bisection and inverse iteration.
function slepian(n, bandwidth, count) {
  const c = Math.cos((2 * Math.PI * bandwidth) / n);
  const d = Array.from({ length: n }, (_, i) => ((n - 1 - 2 * i) / 2) ** 2 * c);
  const e = Array.from({ length: n - 1 }, (_, i) => ((i + 1) * (n - 1 - i)) / 2);
  const bound = Math.max(...d.map((x, i) => Math.abs(x) + (e[i] ?? 0) + (e[i - 1] ?? 0)));
  const above = (x) => {
    // how many eigenvalues are larger than x
    let q = d[0] - x,
      number = q > 0 ? 1 : 0;
    for (let i = 1; i < n; i++) {
      q = d[i] - x - (e[i - 1] * e[i - 1]) / (q === 0 ? 1e-300 : q);
      if (q > 0) number++;
    }
    return number;
  };
  return Array.from({ length: count }, (_, k) => {
    let low = -bound,
      high = bound;
    for (let i = 0; i < 100; i++) {
      const middle = (low + high) / 2;
      if (above(middle) > k) low = middle;
      else high = middle;
    }
    let x = Array.from({ length: n }, (_, i) => Math.sin(1 + i * (1 + 0.37 * k)));
    for (let i = 0; i < 4; i++) {
      x = tridiagonal(
        d.map((value) => value - low),
        e,
        x,
      );
      const size = Math.sqrt(dot(x, x));
      x = x.map((value) => value / size);
    }
    return x;
  });
}

// x of a symmetric tridiagonal system, by Gauss with row pivots.
function tridiagonal(d, e, right) {
  const n = d.length,
    a = [...d],
    b = [...e, 0],
    c = new Array(n).fill(0),
    x = [...right],
    below = [...e];
  for (let i = 0; i < n - 1; i++) {
    if (Math.abs(below[i]) > Math.abs(a[i])) {
      [a[i], below[i]] = [below[i], a[i]];
      [b[i], a[i + 1]] = [a[i + 1], b[i]];
      [c[i], b[i + 1]] = [b[i + 1], c[i]];
      [x[i], x[i + 1]] = [x[i + 1], x[i]];
    }
    const f = below[i] / (a[i] === 0 ? 1e-300 : a[i]);
    a[i + 1] -= f * b[i];
    b[i + 1] -= f * c[i];
    x[i + 1] -= f * x[i];
  }
  for (let i = n - 1; i >= 0; i--) {
    x[i] = (x[i] - b[i] * (x[i + 1] ?? 0) - c[i] * (x[i + 2] ?? 0)) / (a[i] === 0 ? 1e-300 : a[i]);
  }
  return x;
}

// Detrending, tapers and transform of a segment: for every bin and taper {re, im}, so that power is Σ |Σ a_m x_m|².
export function binRows(s) {
  return once("rows", s, () => {
    const n = s.length,
      middle = (n - 1) / 2,
      found = [];
    const cos = Float64Array.from({ length: n }, (_, m) => Math.cos((2 * Math.PI * m) / n));
    const sin = Float64Array.from({ length: n }, (_, m) => Math.sin((2 * Math.PI * m) / n));
    let line = 0;
    for (let m = 0; m < n; m++) line += (m - middle) ** 2;
    const clear = (row) => {
      if (s.detrend === "none") return row;
      const mean = row.reduce((sum, x) => sum + x, 0) / n;
      row = row.map((x) => x - mean);
      if (s.detrend !== "linear") return row;
      const slope = row.reduce((sum, x, m) => sum + x * (m - middle), 0) / line;
      return row.map((x, m) => x - slope * (m - middle));
    };
    for (let k = s.first_bin; k <= s.last_bin; k++) {
      const size = Math.sqrt((k === 0 || 2 * k === n ? 1 : 2) / s.rate);
      found.push(
        tapersOf(s).map((taper) => ({
          re: clear(Float64Array.from(taper, (w, m) => size * w * cos[(k * m) % n])),
          im: clear(Float64Array.from(taper, (w, m) => -size * w * sin[(k * m) % n])),
        })),
      );
    }
    return found;
  });
}

// α_k(l), l >= 0, so that expected Welch power is Σ_l α_k(l) r(l).
export function lagWeights(s) {
  return once("lags", s, () =>
    binRows(s).map((tapers) => {
      const sum = new Float64Array(s.length);
      for (const { re, im } of tapers) autocorrelation(re, im, s.length).forEach((x, l) => (sum[l] += l ? 2 * x : x));
      return sum;
    }),
  );
}

// The low-pass as second-order sections [b0, b1, b2, a1, a2] of gain 1 at 0 Hz; none without a cut-off.
export function sections(s) {
  if (s.filter_cutoff === "none" || s.filter_cutoff === null) return [];
  return once("sections", s, () => {
    const n = s.filter_order,
      w = Math.tan((Math.PI * s.filter_cutoff) / s.rate),
      found = [];
    for (let k = 0; k < Math.floor(n / 2); k++) {
      const damp = 2 * Math.sin((Math.PI * (2 * k + 1)) / (2 * n)),
        a0 = 1 + damp * w + w * w,
        b = (w * w) / a0;
      found.push([b, 2 * b, b, (2 * (w * w - 1)) / a0, (1 - damp * w + w * w) / a0]);
    }
    if (n % 2) found.push([w / (1 + w), w / (1 + w), 0, (w - 1) / (1 + w), 0]);
    return found;
  });
}

// What the sections make of a signal, from rest.
export function filtered(s, signal) {
  let x = Float64Array.from(signal);
  for (const [b0, b1, b2, a1, a2] of sections(s)) {
    let p = 0,
      q = 0;
    x = x.map((value) => {
      const y = b0 * value + p;
      p = b1 * value - a1 * y + q;
      q = b2 * value - a2 * y;
      return y;
    });
  }
  return x;
}

// The low-pass of a recording as the settings direct it: forwards, or forwards and backwards about a steady start.
export function lowpass(s, signal) {
  if (s.filter_direction !== "both" || !sections(s).length) return filtered(s, signal);
  const n = signal.length,
    edge = 3 * (2 * sections(s).length + 1 - (s.filter_order % 2));
  const x = Float64Array.from({ length: n + 2 * edge }, (_, i) => {
    const j = i - edge;
    return j < 0 ? 2 * signal[0] - signal[-j] : j >= n ? 2 * signal[n - 1] - signal[2 * n - 2 - j] : signal[j];
  });
  const steady = (y) =>
    filtered(
      s,
      y.map((value) => value - y[0]),
    )
      .map((value) => value + y[0])
      .reverse();
  return steady(steady(x)).slice(edge, edge + n);
}

// ρ(l), l >= 0: the autocorrelation of the low-pass's impulse response.
export function spreadOf(s) {
  if (!sections(s).length) return Float64Array.of(1);
  return once("spread", s, () => {
    const size = 64 * s.length,
      impulse = new Float64Array(size);
    impulse[0] = 1;
    let spread = autocorrelation(filtered(s, impulse), null, size);
    const reachOf = (x) => {
      let last = x.length - 1;
      while (Math.abs(x[last]) <= TAIL * Math.abs(x[0])) last--;
      return last;
    };
    if (s.filter_direction === "both") {
      const reach = Math.min(2 * reachOf(spread), size - 1);
      const whole = Float64Array.from({ length: 2 * reach + 1 }, (_, i) => spread[Math.abs(i - reach)]);
      spread = autocorrelation(whole, null, whole.length);
    }
    return spread.slice(0, reachOf(spread) + 1);
  });
}

// Frequency response of the low-pass at z = exp(i angle), as [re, im].
export function lowpassGain(s, angle) {
  let re = 1,
    im = 0;
  const c1 = Math.cos(angle),
    s1 = -Math.sin(angle),
    c2 = Math.cos(2 * angle),
    s2 = -Math.sin(2 * angle);
  for (const [b0, b1, b2, a1, a2] of sections(s)) {
    const x = b0 + b1 * c1 + b2 * c2,
      y = b1 * s1 + b2 * s2,
      u = 1 + a1 * c1 + a2 * c2,
      v = a1 * s1 + a2 * s2;
    const size = u * u + v * v,
      p = (x * u + y * v) / size,
      q = (y * u - x * v) / size;
    [re, im] = [re * p - im * q, re * q + im * p];
  }
  return s.filter_direction === "both" ? [re * re + im * im, 0] : [re, im];
}

// The low-pass against aliases for one of `every` points: a windowed sinc, Kaiser with β = 5, gain 1 at 0 Hz.
export function antiAlias(every) {
  return once("anti-alias", every, () => {
    const centre = REACH * every;
    const taps = Array.from({ length: 2 * centre + 1 }, (_, i) => {
      const x = (i - centre) / every,
        sinc = x === 0 ? 1 : Math.sin(Math.PI * x) / (Math.PI * x);
      return sinc * bessel0(5 * Math.sqrt(Math.max(1 - ((i - centre) / centre) ** 2, 0)));
    });
    const sum = taps.reduce((a, b) => a + b, 0);
    return Float64Array.from(taps, (x) => x / sum);
  });
}

// Welch power of a signal in the bins.
export function welch(s, signal) {
  const count = segmentsIn(s, signal.length),
    rows = binRows(s);
  return rows.map((tapers) => {
    let sum = 0;
    for (let k = 0; k < count; k++) {
      const from = k * stepOf(s);
      for (const { re, im } of tapers) {
        let x = 0,
          y = 0;
        for (let m = 0; m < s.length; m++) {
          x += re[m] * signal[from + m];
          y += im[m] * signal[from + m];
        }
        sum += x * x + y * y;
      }
    }
    return sum / count;
  });
}
