// How Welch bins scatter, chi² of a target, and which directions of the parameters the data do not determine.
import { dot, digamma, eigenOfSymmetric, solve, transpose, trigamma } from "./numbers.mjs";
import { binRows, stepOf } from "./settings.mjs";
import { get, withValues } from "./task.mjs";

const LEAST = 1e-3,
  STEP = 1e-4;

// Degrees of freedom of every bin, and the correlation of bins, of trials with so many segments each.
const laws = new Map();
export function welchLaw(settings, bins, segments) {
  const key = JSON.stringify([settings, bins, segments]);
  if (!laws.has(key)) laws.set(key, lawOf(settings, bins, segments));
  return laws.get(key);
}

function lawOf(settings, bins, segments) {
  const rows = bins.map((k) => binRows(settings)[k - settings.first_bin]),
    n = settings.length,
    step = stepOf(settings);
  const total = segments.reduce((a, b) => a + b, 0),
    weight = new Map(); // of segments j apart
  for (const count of segments) {
    for (
      let j = -Math.min(count - 1, Math.floor((n - 1) / step));
      j <= Math.min(count - 1, Math.floor((n - 1) / step));
      j++
    ) {
      weight.set(j, (weight.get(j) ?? 0) + (count * (1 - Math.abs(j) / count)) / total ** 2);
    }
  }
  const together = (a, b, j) => {
    // Σ over tapers of |Σ a conj(b)|² + |Σ a b|², b so many samples ahead
    const [p, q] = [Math.max(j, 0), Math.max(-j, 0)],
      length = n - Math.abs(j);
    let sum = 0;
    for (const x of a) {
      for (const y of b) {
        let rr = 0,
          ii = 0,
          ri = 0,
          ir = 0;
        for (let m = 0; m < length; m++) {
          const xr = x.re[m + p],
            xi = x.im[m + p],
            yr = y.re[m + q],
            yi = y.im[m + q];
          rr += xr * yr;
          ii += xi * yi;
          ri += xr * yi;
          ir += xi * yr;
        }
        sum += (rr + ii) ** 2 + (ir - ri) ** 2 + (rr - ii) ** 2 + (ir + ri) ** 2;
      }
    }
    return sum;
  };
  const covariance = rows.map(() => new Array(rows.length).fill(0));
  rows.forEach((a, k) => {
    for (let l = 0; l <= k; l++) {
      let sum = 0;
      for (const [j, w] of weight) sum += w * together(a, rows[l], j * step);
      covariance[k][l] = covariance[l][k] = sum;
    }
  });
  const power = rows.map((row) => row.reduce((sum, { re, im }) => sum + dot(re, re) + dot(im, im), 0));
  const sd = covariance.map((row, k) => Math.sqrt(row[k]));
  return {
    degrees: power.map((p, k) => (2 * p * p) / sd[k] ** 2),
    correlation: covariance.map((row, k) => row.map((x, l) => x / sd[k] / sd[l])),
  };
}

// Offset and standard deviation of the target's log powers: from its segments, else from its sigma, else unknown.
export function statisticsOf(target, settings, share) {
  const n = target.bins.length,
    unit = Array.from({ length: n }, (_, i) => Array.from({ length: n }, (_, j) => Number(i === j)));
  if (target.segments) {
    const law = welchLaw(settings, target.bins, target.segments),
      wider = Math.max(1, target.dispersion?.[0] ?? 1) ** 2;
    const half = law.degrees.map((nu, k) => nu / wider / Math.max(1 - share[k] ** 2, LEAST) / 2);
    return {
      bias: half.map((x) => digamma(x) - Math.log(x)),
      sd: half.map((x) => Math.sqrt(trigamma(x))),
      correlation: law.correlation,
      known: true,
    };
  }
  const sd = target.sigma
    ? target.sigma.map((s, k) => Math.sqrt(Math.log1p((s / target.proportional_power[k]) ** 2)))
    : new Array(n).fill(1);
  return { bias: new Array(n).fill(0), sd, correlation: unit, known: Boolean(target.sigma) };
}

// How far a target's log powers lie from a spectrum, bin by bin, and chi² per bin (null where the scatter is not known).
export function compared(target, settings, { power, line }) {
  const at = target.bins.map((k) => k - settings.first_bin),
    fitted = at.map((k) => power[k]),
    sum = fitted.reduce((a, b) => a + b, 0);
  const { bias, sd, correlation, known } = statisticsOf(
    target,
    settings,
    at.map((k) => line[k] / power[k]),
  );
  const z = target.proportional_power.map((p, k) => Math.log(p) - Math.log(fitted[k] / sum) - bias[k]);
  const mean = z.reduce((a, b) => a + b, 0) / z.length,
    residuals = z.map((x, k) => (x - mean) / sd[k]);
  const chi2 = known ? residuals.reduce((s, x) => s + x * x, 0) / (z.length - 1) : null;
  return { fitted: fitted.map((p) => p / sum), residuals, chi2, sd, bias, correlation, level: sum / Math.exp(mean) };
}

// Fisher information of a proportional spectrum, its total unknown, in the priors' standard deviations: eigenvalues rising.
export function directions(table, names, parameters, spectrumOf, sd, correlation, at) {
  const logs = (values) => {
    const { power } = spectrumOf(withValues(table, values));
    return at.map((k) => Math.log(power[k]));
  };
  const slopes = names.map((name) => {
    const value = get(table, name),
      row = parameters[name],
      h = STEP * (row.positive ? 1 : row.prior_sd);
    const moved = (sign) => (row.positive ? value * Math.exp(sign * h) : value + sign * h);
    const [up, down] = [logs({ [name]: moved(1) }), logs({ [name]: moved(-1) })];
    return up.map((x, k) => ((x - down[k]) / (2 * h)) * row.prior_sd);
  });
  const C = correlation.map((row, k) => row.map((x, l) => x * sd[k] * sd[l]));
  const ones = at.map(() => 1),
    solved = transpose(solve(C, transpose([ones, ...slopes])));
  const total = dot(ones, solved[0]);
  const F = slopes.map((a) =>
    slopes.map((b, j) => dot(a, solved[j + 1]) - (dot(ones, solved[j + 1]) * dot(a, solved[0])) / total),
  );
  const { values, vectors } = eigenOfSymmetric(F.map((row, i) => row.map((x, j) => (x + F[j][i]) / 2)));
  return values.map((value, i) => {
    const largest = vectors[i].reduce((most, x) => (Math.abs(x) > Math.abs(most) ? x : most), 0),
      sign = largest < 0 ? -1 : 1;
    return {
      strength: Math.sqrt(Math.max(value, 0)),
      shares: Object.fromEntries(names.map((name, k) => [name, sign * vectors[i][k]])),
    };
  });
}

// The values so many prior standard deviations along a direction.
export function movedAlong(table, shares, parameters, distance) {
  return Object.fromEntries(
    Object.entries(shares).map(([name, share]) => {
      const { positive, prior_sd } = parameters[name],
        value = get(table, name),
        far = share * prior_sd * distance;
      return [name, positive ? value * Math.exp(far) : value + far];
    }),
  );
}
