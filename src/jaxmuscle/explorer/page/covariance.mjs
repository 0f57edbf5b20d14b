// The autocovariance of a task's sampled output under noise, in linear response.
import { apply, blocks, dot, expm, eye, outer, plus, product, scaledBy, sylvester, transpose, zeros } from "./numbers.mjs";
import { shapingFilter } from "./noise.mjs";
import { FINER, antiAlias } from "./settings.mjs";
import { ACTIVE, actsOn, baseOf, componentsOf } from "./task.mjs";

// Systems one behind the other, x' = M x + Γ w, with the stationary covariance of their states, built up.
function chainOf({ F, G, L }) {
  const chain = { matrix: F, white: G, covariance: sylvester(F, F, product(G, transpose(G))), inputs: L.length };
  chain.add = (A, inflow, white) => {
    const before = chain.matrix.length,
      n = A.length;
    const fed = before ? product(inflow, chain.covariance) : zeros(n, 0);
    const cross = sylvester(A, chain.matrix, before ? plus(fed, product(white, transpose(chain.white))) : fed);
    const through = before ? product(inflow, transpose(cross)) : zeros(n, n);
    const inner = sylvester(A, A, plus(plus(through, transpose(through)), product(white, transpose(white))));
    chain.matrix = blocks(chain.matrix, zeros(before, n), before ? inflow : zeros(n, 0), A);
    chain.covariance = blocks(chain.covariance, transpose(cross, before), cross, inner);
    chain.white = [...chain.white, ...white];
    return before;
  };
  chain.filled = (row) => [...row, ...new Array(chain.matrix.length - row.length).fill(0)];
  return chain;
}

export const activationStates = (time) => [
  [
    [0, 1 / time],
    [-1 / time, -2 / time],
  ],
  [0, 1 / time],
];

// Amplitudes of a component of the noise in the units of the inputs that it acts on.
export function noiseScale(table, part) {
  const base = [...baseOf(table), 1],
    on = actsOn(part);
  return part.amplitude.map((a, j) => (part.relative === false || on.length === 1 ? a : a * base[on[j]]));
}

// Of one component through some of its inputs: r(s) = Σ row exp(matrix s) start.
function covarianceOf(table, system, part, groups) {
  const scale = noiseScale(table, part),
    on = actsOn(part),
    made = shapingFilter(part),
    chain = chainOf(made),
    rows = [];
  const columnOf = (j) => system.B.map((row) => row[on[j]] * scale[j]);
  for (const [active, group] of groups) {
    let value = chain.filled(made.H),
      white = made.L;
    if (active) {
      const [own, into] = activationStates(table.activation.time);
      const first = chain.add(own, outer(into, value), outer(into, white));
      value = chain.filled([]);
      value[first] = 1;
      white = white.map(() => 0);
    }
    const slope = chain.matrix.length
      ? chain.matrix[0].map((_, j) => value.reduce((sum, x, i) => sum + x * chain.matrix[i][j], 0))
      : [];
    chain.add(transpose(system.A), outer(system.C, value), outer(system.C, white));
    for (const j of group) {
      const d = system.D[on[j]] * scale[j],
        e = system.E[on[j]] * scale[j];
      rows.push([...value.map((x, i) => d * x + e * slope[i]), ...columnOf(j)]);
    }
  }
  let all = rows.map((row) => chain.filled(row));
  if (part.shared) all = [all.reduce((sum, row) => sum.map((x, i) => x + row[i]))];
  return { matrix: chain.matrix, rows: all, start: product(all, chain.covariance) };
}

// The independent parts of the response to each component.
export function covariances(table, system) {
  return componentsOf(table).map((part) => {
    const on = actsOn(part),
      active = (j) => Boolean(table.activation) && ACTIVE.includes(on[j]);
    const groups = [true, false].map((a) => [
      a,
      on.map((_, j) => j).filter((j) => active(j) === a && part.amplitude[j] !== 0),
    ]);
    const some = groups.filter(([, group]) => group.length);
    if (!some.length) return [];
    return (part.shared ? [some] : some.map((group) => [group])).map((own) => covarianceOf(table, system, part, own));
  });
}

// r at the lags 0, Δ, 2Δ ... of the sampled output.
export function lagged({ matrix, rows, start }, settings, lags) {
  const interval = 1 / settings.rate,
    n = matrix.length;
  const stepped = (Phi, first, from, readers, count) => {
    const r = new Float64Array(count),
      flat = Float64Array.from(Phi.flat());
    r[0] = first;
    from.forEach((vector, c) => {
      let x = Float64Array.from(vector),
        y = new Float64Array(n);
      const reader = readers[c];
      for (let l = 1; l < count; l++) {
        let sum = 0;
        for (let i = 0; i < n; i++) sum += reader[i] * x[i];
        r[l] += sum;
        for (let i = 0, at = 0; i < n; i++) {
          let next = 0;
          for (let j = 0; j < n; j++, at++) next += flat[at] * x[j];
          y[i] = next;
        }
        [x, y] = [y, x];
      }
    });
    return r;
  };
  const zero = rows.reduce((sum, row, c) => sum + dot(row, start[c]), 0);
  if (settings.sampling === "average") {
    const O = zeros(n, n),
      I = eye(n);
    const upper = scaledBy(matrix, interval).map((row, i) => [...row, ...I[i], ...O[i]]);
    const whole = expm([...upper, ...O.map((row, i) => [...row, ...O[i], ...I[i]]), ...zeros(n, 3 * n)]);
    const part = (k) => whole.slice(0, n).map((row) => row.slice(k * n, (k + 1) * n));
    const [Phi, mean, ramp] = [part(0), part(1), part(2)];
    const first = rows.reduce((sum, row, c) => sum + 2 * dot(row, apply(ramp, start[c])), 0);
    return stepped(
      Phi,
      first,
      start.map((v) => apply(mean, v)),
      rows.map((row) => apply(transpose(mean), row)),
      lags,
    );
  }
  if (settings.sampling !== "filtered") {
    const Phi = expm(scaledBy(matrix, interval));
    return stepped(
      Phi,
      zero,
      start.map((v) => apply(Phi, v)),
      rows,
      lags,
    );
  }
  const taps = antiAlias(FINER),
    reach = taps.length - 1,
    Phi = expm(scaledBy(matrix, interval / FINER));
  const spread = Float64Array.from({ length: taps.length }, (_, l) => {
    let sum = 0;
    for (let i = 0; i + l < taps.length; i++) sum += taps[i] * taps[i + l];
    return sum;
  });
  const fine = stepped(
    Phi,
    zero,
    start.map((v) => apply(Phi, v)),
    rows,
    FINER * (lags - 1) + reach + 1,
  );
  // The signal is known at all times: near lag 0, where r has a kink, the sum is made an integral (Gregory's rule).
  const kink = KINK.map((weights) => weights.reduce((sum, w, i) => sum + w * fine[i], 0));
  return Float64Array.from({ length: lags }, (_, l) => {
    const k = FINER * l,
      bent = k + 1 < spread.length ? spread[Math.abs(k - 1)] - 2 * spread[k] + spread[k + 1] : 0;
    return convolvedAt(fine, spread, k) - (spread[k] ?? 0) * kink[0] + bent * kink[1];
  });
}

// Weights of r at 0, δ, 2δ ...: what a sum in steps of δ exceeds the integral by, and -δ r' / 120.
const KINK = [
  [0.43962080711212653, -1.3001848720338303, 2.416610850569184, -3.621803551386885, 3.9911629439233605, -3.151921872494789, 1.735732122815456, -0.6335751362834696, 0.13793040774811607, -0.013571699969269414],
  [0.02357473544973545, -0.075, 0.15, -0.23333333333333334, 0.2625, -0.21000000000000002, 0.11666666666666667, -0.04285714285714286, 0.009375, -0.0009259259259259259],
];

// Σ_j ρ(|j|) r(|l - j|)
export function convolvedAt(r, spread, l) {
  let sum = spread[0] * r[l];
  for (let j = 1; j < spread.length; j++) sum += spread[j] * (r[Math.abs(l - j)] + r[l + j]);
  return sum;
}
