// A trace of the task, from equilibrium with held inputs: Heun's method, of the muscle itself or of its linearisation.
import { apply, cholesky, dot, expm, normals, plus, product, scaledBy, sylvester, transpose } from "./numbers.mjs";
import { shapingFilter } from "./noise.mjs";
import { WINDOW, antiAlias } from "./settings.mjs";
import { activationStates, noiseScale } from "./covariance.mjs";
import { ACTIVE, actsOn, baseOf, componentsOf, linearise, mechanicsOf, signalAt } from "./task.mjs";

const LONGEST_STEP = 1e-3,
  STEPS = 400000;

// Of one noise, all channels: `next()` goes on by a step, `values` and `slopes` hold after it.
function noisePath(part, dt, draw) {
  const { F, G, H, L } = shapingFilter(part),
    n = F.length,
    channels = part.shared ? 1 : actsOn(part).length;
  const P = sylvester(F, F, product(G, transpose(G))),
    Phi = expm(scaledBy(F, dt));
  const kick = n ? cholesky(plus(P, scaledBy(product(product(Phi, P), transpose(Phi)), -1))) : [],
    begin = cholesky(P);
  const slope = n ? transpose(F).map((column) => dot(column, H)) : [];
  const states = Array.from({ length: channels }, () =>
    apply(
      begin,
      begin.map(() => draw()),
    ),
  );
  const path = { values: [], slopes: [] };
  const read = () => {
    path.values = states.map((q) => (n ? dot(H, q) : (L[0] / Math.sqrt(dt)) * draw()));
    path.slopes = states.map((q) => (n ? dot(slope, q) : 0));
  };
  path.next = () => {
    states.forEach((q, c) => {
      const z = kick.map(() => draw());
      states[c] = apply(Phi, q).map((x, i) => x + dot(kick[i], z));
    });
    read();
  };
  path.white = !n;
  read();
  return path;
}

// {time, output} sampled at the settings' rate; `from` and `to` in s. An Error where the numbers leave all bounds.
export function simulate(table, { seed = 1, linear = false, to = WINDOW[1] } = {}) {
  const s = table.settings,
    system = linearise(table),
    mechanics = mechanicsOf(table),
    draw = normals(seed);
  const scale = system.A.map((row) => row.reduce((sum, x) => sum + Math.abs(x), 0));
  const fastest = Math.max(
    ...system.A.map((row, i) => Math.sqrt(scale[i] * Math.max(...system.A.map((r) => Math.abs(r[i]))))),
  );
  const each = Math.max(Math.ceil(Math.max(1 / (s.rate * LONGEST_STEP), (2 * fastest) / s.rate)), 1),
    dt = 1 / (s.rate * each);
  const steps = Math.round(to * s.rate) * each;
  if (steps > STEPS) throw new Error("The muscle is too stiff for a trace here: its fastest rate needs very small steps.");
  const base = baseOf(table),
    h = table.harmonic,
    omega = 2 * Math.PI * h.frequency;
  const parts = componentsOf(table).map((part) => ({
    on: actsOn(part),
    scale: noiseScale(table, part),
    path: noisePath(part, dt, draw),
  }));
  const harmonicAt = (t) => {
    const [a, slope] = signalAt(h.envelope, t),
      turn = omega * t + h.phase;
    return [h.amplitude * a * Math.sin(turn), h.amplitude * (slope * Math.sin(turn) + a * omega * Math.cos(turn))];
  };
  const raw = (t) => {
    // inputs before the activation, and their slopes
    const [wave, rise] = harmonicAt(t),
      u = [base[0] * wave, base[1] * wave, 0, 0, 0],
      du = [base[0] * rise, base[1] * rise, 0, 0, 0];
    for (const { on, scale, path } of parts) {
      on.forEach((input, j) => {
        const c = Math.min(j, path.values.length - 1);
        u[input] += scale[j] * path.values[c];
        du[input] += scale[j] * path.slopes[c];
      });
    }
    return { u, du };
  };
  const T = table.activation?.time,
    [own, into] = T ? activationStates(T) : [];
  const twitch = (state, n) => apply(own, state).map((x, i) => x + into[i] * n);
  let y = [...system.point],
    now = raw(0),
    active = T ? ACTIVE.map((i) => [now.u[i], 0]) : [];
  const seen = ({ u, du }, states) => {
    const through = { u: [...u], du: [...du] };
    if (T)
      ACTIVE.forEach((i, k) => {
        through.u[i] = states[k][0];
        through.du[i] = states[k][1] / T;
      });
    return through;
  };
  const away = (state) => state.map((x, i) => x - system.point[i]);
  const field = (state, u) =>
    linear ? system.A.map((row, i) => dot(row, away(state)) + dot(system.B[i], u)) : mechanics.field(state, u);
  const output = (state, { u, du }) =>
    linear
      ? system.rest + dot(system.C, away(state)) + dot(system.D, u) + dot(system.E, du)
      : mechanics.output(state, u, du);
  const values = new Float64Array(steps + 1);
  values[0] = output(y, seen(now, active));
  for (let k = 0; k < steps; k++) {
    for (const { path } of parts) path.next();
    const after = raw((k + 1) * dt),
      before = parts.some(({ path }) => path.white) ? { u: whiteNow(now.u, after.u, parts) } : now;
    const nextActive = active.map((state, i) => {
      const a = twitch(state, before.u[ACTIVE[i]]),
        guess = state.map((x, j) => x + dt * a[j]),
        b = twitch(guess, after.u[ACTIVE[i]]);
      return state.map((x, j) => x + 0.5 * dt * (a[j] + b[j]));
    });
    const u0 = seen({ u: before.u, du: now.du }, active).u,
      u1 = seen(after, nextActive).u;
    const a = field(y, u0),
      b = field(
        y.map((x, i) => x + dt * a[i]),
        u1,
      );
    y = y.map((x, i) => x + 0.5 * dt * (a[i] + b[i]));
    now = after;
    active = nextActive;
    values[k + 1] = output(y, seen(now, active));
  }
  if (!values.every(Number.isFinite))
    throw new Error("The simulation left all bounds: the perturbations are too large for this muscle.");
  return { output: sampledFrom(values, each, s.sampling), interval: 1 / s.rate };
}

// White noise is one number in a step, the same at its begin and its end.
function whiteNow(before, after, parts) {
  const white = new Set(parts.filter(({ path }) => path.white).flatMap(({ on }) => on));
  return before.map((x, i) => (white.has(i) ? after[i] : x));
}

function sampledFrom(values, each, sampling) {
  const count = Math.floor((values.length - 1) / each) + 1;
  if (sampling === "instant" || each === 1) return Float64Array.from({ length: count }, (_, k) => values[k * each]);
  if (sampling === "average") {
    return Float64Array.from({ length: count }, (_, k) => {
      let sum = k ? 0 : values[0] * each;
      for (let i = 1; k && i <= each; i++) sum += values[(k - 1) * each + i];
      return sum / each;
    });
  }
  const taps = antiAlias(each),
    centre = (taps.length - 1) / 2,
    last = values.length - 1;
  return Float64Array.from({ length: count }, (_, k) => {
    let sum = 0;
    for (let i = 0; i < taps.length; i++) sum += taps[i] * values[Math.min(Math.max(k * each + i - centre, 0), last)];
    return sum;
  });
}
