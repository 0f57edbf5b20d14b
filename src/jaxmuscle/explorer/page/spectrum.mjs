// The expected Welch spectrum of a task in linear response, in closed form: what jaxmuscle.expected_spectrum computes.
import { apply, blocks, dot, expm, eye, outer, plus, product, scaledBy, solve, sylvester, transpose, zeros } from "./numbers.mjs";
import { shapingFilter } from "./noise.mjs";
import { FINER, WINDOW, antiAlias, binRows, lagWeights, lowpass, lowpassGain, samplesIn, segmentsIn, spreadOf, stepOf, welch } from "./settings.mjs";
import { ACTIVE, actsOn, baseOf, componentsOf, isStable, linearise, signalAt } from "./task.mjs";

// Systems one behind the other, x' = M x + Γ w, with the stationary covariance of their states, built up.
function chainOf({ F, G, L }) {
  const chain = { matrix: F, white: G, covariance: sylvester(F, F, product(G, transpose(G))), inputs: L.length };
  chain.add = (A, inflow, white) => {
    const before = chain.matrix.length, n = A.length;
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

export const activationStates = (time) => [[[0, 1 / time], [-1 / time, -2 / time]], [0, 1 / time]];

// Amplitudes of a component of the noise in the units of the inputs that it acts on.
export function noiseScale(table, part) {
  const base = [...baseOf(table), 1], on = actsOn(part);
  return part.amplitude.map((a, j) => (part.relative === false || on.length === 1 ? a : a * base[on[j]]));
}

// Of one component through some of its inputs: r(s) = Σ row exp(matrix s) start.
function covarianceOf(table, system, part, groups) {
  const scale = noiseScale(table, part), on = actsOn(part), made = shapingFilter(part), chain = chainOf(made), rows = [];
  const columnOf = (j) => system.B.map((row) => row[on[j]] * scale[j]);
  for (const [active, group] of groups) {
    let value = chain.filled(made.H), white = made.L;
    if (active) {
      const [own, into] = activationStates(table.activation.time);
      const first = chain.add(own, outer(into, value), outer(into, white));
      value = chain.filled([]); value[first] = 1;
      white = white.map(() => 0);
    }
    const slope = chain.matrix.length ? chain.matrix[0].map((_, j) => value.reduce((sum, x, i) => sum + x * chain.matrix[i][j], 0)) : [];
    chain.add(transpose(system.A), outer(system.C, value), outer(system.C, white));
    for (const j of group) {
      const d = system.D[on[j]] * scale[j], e = system.E[on[j]] * scale[j];
      rows.push([...value.map((x, i) => d * x + e * slope[i]), ...columnOf(j)]);
    }
  }
  let all = rows.map((row) => chain.filled(row));
  if (part.shared) all = [all.reduce((sum, row) => sum.map((x, i) => x + row[i]))];
  return { matrix: chain.matrix, rows: all, start: product(all, chain.covariance) };
}

// The independent parts of the response to each component.
function covariances(table, system) {
  return componentsOf(table).map((part) => {
    const on = actsOn(part), active = (j) => Boolean(table.activation) && ACTIVE.includes(on[j]);
    const groups = [true, false].map((a) => [a, on.map((_, j) => j).filter((j) => active(j) === a && part.amplitude[j] !== 0)]);
    const some = groups.filter(([, group]) => group.length);
    if (!some.length) return [];
    return (part.shared ? [some] : some.map((group) => [group])).map((own) => covarianceOf(table, system, part, own));
  });
}

// r at the lags 0, Δ, 2Δ ... of the sampled output.
function lagged({ matrix, rows, start }, settings, lags) {
  const interval = 1 / settings.rate, n = matrix.length;
  const stepped = (Phi, first, from, readers, count) => {
    const r = new Float64Array(count), flat = Float64Array.from(Phi.flat());
    r[0] = first;
    from.forEach((vector, c) => {
      let x = Float64Array.from(vector), y = new Float64Array(n);
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
    const O = zeros(n, n), I = eye(n);
    const upper = scaledBy(matrix, interval).map((row, i) => [...row, ...I[i], ...O[i]]);
    const whole = expm([...upper, ...O.map((row, i) => [...row, ...O[i], ...I[i]]), ...zeros(n, 3 * n)]);
    const part = (k) => whole.slice(0, n).map((row) => row.slice(k * n, (k + 1) * n));
    const [Phi, mean, ramp] = [part(0), part(1), part(2)];
    const first = rows.reduce((sum, row, c) => sum + 2 * dot(row, apply(ramp, start[c])), 0);
    return stepped(Phi, first, start.map((v) => apply(mean, v)), rows.map((row) => apply(transpose(mean), row)), lags);
  }
  if (settings.sampling !== "filtered") {
    const Phi = expm(scaledBy(matrix, interval));
    return stepped(Phi, zero, start.map((v) => apply(Phi, v)), rows, lags);
  }
  const taps = antiAlias(FINER), reach = taps.length - 1, Phi = expm(scaledBy(matrix, interval / FINER));
  const spread = Float64Array.from({ length: taps.length }, (_, l) => { let sum = 0; for (let i = 0; i + l < taps.length; i++) sum += taps[i] * taps[i + l]; return sum; });
  const fine = stepped(Phi, zero, start.map((v) => apply(Phi, v)), rows, FINER * (lags - 1) + reach + 1);
  return Float64Array.from({ length: lags }, (_, l) => convolvedAt(fine, spread, FINER * l));
}

// Σ_j ρ(|j|) r(|l - j|)
function convolvedAt(r, spread, l) {
  let sum = spread[0] * r[l];
  for (let j = 1; j < spread.length; j++) sum += spread[j] * (r[Math.abs(l - j)] + r[l + j]);
  return sum;
}

// The response to one signal that acts on every input by so much, through the activation where that is: y' = A y + b h.
export function signalSystem(table, system, base) {
  const on = table.activation ? ACTIVE : [], later = base.map((x, i) => (on.includes(i) ? x : 0)), now = base.map((x, i) => x - later[i]);
  const own = { b: apply(system.B, now), d: dot(system.D, now), e: dot(system.E, now) };
  if (!table.activation) return { A: system.A, c: system.C, ...own };
  const [F, into] = activationStates(table.activation.time), n = system.A.length, d = dot(system.D, later), e = dot(system.E, later);
  return { A: blocks(system.A, outer(apply(system.B, later), [1, 0]), zeros(2, n), F), b: [...own.b, ...into],
           c: [...system.C, d + e * F[0][0], e * F[0][1]], d: own.d, e: own.e };
}

// c (iω - A)⁻¹ b + d + iω e, as [re, im].
export function transfer({ A, b, c, d, e }, omega) {
  const n = A.length, minus = scaledBy(A, -1), turn = eye(n).map((row) => row.map((x) => omega * x));
  const x = solve(blocks(minus, scaledBy(turn, -1), turn, minus), [...b.map((v) => [v]), ...b.map(() => [0])]).map((row) => row[0]);
  return [dot(c, x.slice(0, n)) + d, dot(c, x.slice(n)) + omega * e];
}

const times = ([a, b], [c, d]) => [a * c - b * d, a * d + b * c];
const turned = (angle) => [Math.cos(angle), Math.sin(angle)];

// What sampling makes of a line that turns by `angle` in an interval.
function sampledGain(angle, sampling) {
  if (sampling === "average") return [Math.sin(angle) / angle, (Math.cos(angle) - 1) / angle];
  if (sampling !== "filtered") return [1, 0];
  const taps = antiAlias(FINER), centre = (taps.length - 1) / 2;
  return [taps.reduce((sum, x, i) => sum + x * Math.cos((angle * (i - centre)) / FINER), 0), 0];
}

const harmonicBase = (table) => [...baseOf(table).slice(0, 2), 0, 0, 0];

// Welch power of the harmonic, phase and leakage included, and its variance in the window.
function harmonicLine(table, system, settings) {
  const h = table.harmonic, level = h.envelope.type === "Constant" ? h.envelope.level : null;
  if (h.amplitude === 0) return { power: binRows(settings).map(() => 0), variance: 0 };
  if (level === null) return envelopedLine(table, system, settings);
  const omega = 2 * Math.PI * h.frequency, angle = omega / settings.rate, n = settings.length;
  const through = times(sampledGain(angle, settings.sampling), lowpassGain(settings, angle));
  const size = h.amplitude * level;
  const reply = times(times(transfer(signalSystem(table, system, harmonicBase(table)), omega), turned(h.phase)), [size, 0]);
  const samples = samplesIn(settings), start = Math.round(WINDOW[0] * settings.rate), count = segmentsIn(settings, samples);
  const line = times(times(reply, reply), times(through, through)); // (r g)²
  const strength = Math.hypot(...line);
  let twice = [0, 0];
  for (let k = 0; k < count; k++) { const t = turned(2 * angle * (start + k * stepOf(settings))); twice = [twice[0] + t[0] / count, twice[1] + t[1] / count]; }
  const cos = Float64Array.from({ length: n }, (_, m) => Math.cos(angle * m)), sin = Float64Array.from({ length: n }, (_, m) => Math.sin(angle * m));
  const power = binRows(settings).map((tapers) => {
    let level = 0, both = [0, 0];
    for (const { re, im } of tapers) {
      let cc = 0, cs = 0, sc = 0, ss = 0;
      for (let m = 0; m < n; m++) { cc += re[m] * cos[m]; cs += re[m] * sin[m]; sc += im[m] * cos[m]; ss += im[m] * sin[m]; }
      const ahead = [cc - ss, cs + sc], behind = [cc + ss, sc - cs];
      level += ahead[0] ** 2 + ahead[1] ** 2 + behind[0] ** 2 + behind[1] ** 2;
      const cross = times(ahead, [behind[0], -behind[1]]);
      both = [both[0] + cross[0], both[1] + cross[1]];
    }
    return Math.max(0.25 * strength * level - 0.5 * times(line, times(twice, both))[0], 0);
  });
  const mean = (k) => { // of exp(i k angle m) over the samples of the window
    const half = (k * angle) / 2, ratio = Math.abs(Math.sin(half)) < 1e-300 ? 1 : Math.sin(samples * half) / (samples * Math.sin(half));
    return times(turned(k * angle * (start + (samples - 1) / 2)), [ratio, 0]);
  };
  const once = times(times(reply, through), mean(1))[1];
  return { power, variance: 0.5 * (strength - times(line, mean(2))[0]) - once ** 2 };
}

// The same for an envelope that changes: stepped exactly in the frame that turns with the harmonic, from the steady state.
function envelopedLine(table, system, settings) {
  const h = table.harmonic, { A, b, c, d, e } = signalSystem(table, system, harmonicBase(table)), n = A.length;
  const omega = 2 * Math.PI * h.frequency, interval = 1 / settings.rate, stop = Math.round(WINDOW[1] * settings.rate);
  const turn = scaledBy(eye(n), omega), M = blocks(A, turn, scaledBy(turn, -1), A), N = 2 * n; // real and imaginary part of (A - iω)
  const drive = [...b, ...b.map(() => 0)], whole = zeros(N + 2, N + 2);
  for (let i = 0; i < N; i++) { for (let j = 0; j < N; j++) whole[i][j] = M[i][j] * interval; whole[i][N] = drive[i] * interval; }
  whole[N][N + 1] = 1;
  const E = expm(whole), Phi = E.slice(0, N).map((row) => row.slice(0, N)), held = E.slice(0, N).map((row) => row[N]), ramp = E.slice(0, N).map((row) => row[N + 1]);
  const levels = Array.from({ length: stop }, (_, i) => signalAt(h.envelope, i * interval));
  let Y = solve(M, drive.map((x) => [-x * levels[0][0]])).map((row) => row[0]);
  const gain = sampledGain(omega * interval, settings.sampling), z = new Float64Array(stop);
  for (let i = 0; i < stop; i++) {
    if (i) Y = apply(Phi, Y).map((x, k) => x + held[k] * levels[i - 1][0] + ramp[k] * (levels[i][0] - levels[i - 1][0]));
    const [a, slope] = levels[i], inside = [dot(c, Y.slice(0, n)) + d * a + e * slope, dot(c, Y.slice(n)) + e * omega * a];
    z[i] = h.amplitude * times(inside, times(turned(omega * interval * i + h.phase), gain))[1];
  }
  const seen = lowpass(settings, z).slice(Math.round(WINDOW[0] * settings.rate)), mean = seen.reduce((a, b) => a + b, 0) / seen.length;
  return { power: welch(settings, seen), variance: seen.reduce((sum, x) => sum + (x - mean) ** 2, 0) / seen.length };
}

// {power, line, components, mean, variance, system}; an Error says why there is no linear response.
export function expectedSpectrum(table, settings = table.settings) {
  const system = linearise(table);
  if (!system.point.every(Number.isFinite)) throw new Error("There is no equilibrium: a stiffness must balance the forces. Raise k_w or x_ref_w.");
  if (!isStable(system.A)) throw new Error("The equilibrium is unstable or not damped, so there is no expected spectrum. Raise c_w, c_z or k_w.");
  const weights = lagWeights(settings), spread = spreadOf(settings), samples = samplesIn(settings), reach = spread.length - 1;
  const lags = Math.max(settings.length + reach, samples, reach + 1), own = covariances(table, system), sum = new Float64Array(lags);
  const components = own.map((parts) => {
    const r = new Float64Array(lags);
    for (const part of parts) lagged(part, settings, lags).forEach((x, l) => (r[l] += x));
    r.forEach((x, l) => (sum[l] += x));
    const passed = Float64Array.from({ length: settings.length }, (_, l) => convolvedAt(r, spread, l));
    return weights.map((row) => dot(row, passed));
  });
  const { power: line, variance: swing } = harmonicLine(table, system, settings);
  const power = line.map((x, k) => components.reduce((all, each) => all + each[k], x));
  return { power, line, components, mean: system.rest, variance: noiseVariance(sum, spread, samples) + swing, system };
}

// Variance of so many low-passed samples about their mean.
function noiseVariance(r, spread, samples) {
  let slow = samples * r[0];
  for (let l = 1; l < samples; l++) slow += 2 * (samples - l) * r[l];
  const rho = (j) => spread[Math.abs(j)] ?? 0, reach = spread.length - 1;
  for (let l = 0; l < reach; l++) { // what the low-pass takes off the variance of the mean
    let lowered = -l;
    for (let j = -reach; j <= reach; j++) lowered += rho(j) * Math.abs(l - j);
    slow -= (l ? 2 : 1) * lowered * r[l];
  }
  return convolvedAt(r, spread, 0) - slow / samples ** 2;
}
