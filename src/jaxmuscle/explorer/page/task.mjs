// A task as the table that a preset file holds: its parameters by name, its equations, its linearisation.
import { zeros } from "./numbers.mjs";

export const INPUTS = ["K_w", "K_z", "C_w", "C_z", "P_w"];
export const ACTIVE = [0, 2, 4];
export const HOLD = 15;

export const componentsOf = (table) => (table.noise.type === "NoiseSum" ? table.noise.parts : [table.noise]);
export const actsOn = (part) => ({ 1: [4], 4: [0, 1, 2, 3], 5: [0, 1, 2, 3, 4] })[part.amplitude.length];
const others = {
  WhiteNoise: ["rate"],
  BandLimitedNoise: ["rate", "cutoff"],
  OrnsteinUhlenbeckNoise: ["correlation_time"],
  PinkNoise: [],
  ResonantNoise: ["frequency", "width"],
};

// Where the parameters are in the table, by their names in the package: {name: path}.
export function pathsOf(table) {
  const paths = { m_w: ["muscle", "m_w"], m_z: ["muscle", "m_z"] },
    counts = {};
  for (const j of ["w", "z"]) {
    for (const [law, names] of [
      ["stiffness", ["k", "x_ref"]],
      ["damping", ["c", "v_ref"]],
    ]) {
      for (const name of names) paths[`${name}_${j}`] = ["muscle", `${law}_${j}`, name];
    }
  }
  componentsOf(table).forEach((part, i) => {
    const sort = part.type === "ResonantNoise" ? "resonance" : "noise";
    counts[sort] = (counts[sort] ?? 0) + 1;
    const first = counts[sort] === 1 ? `${sort}_` : `${sort}_${counts[sort]}_`;
    const here = table.noise.type === "NoiseSum" ? ["noise", "parts", i] : ["noise"];
    const alone = sort === "resonance" && part.amplitude.length === 1;
    actsOn(part).forEach((input, k) => (paths[first + (alone ? "amplitude" : INPUTS[input])] = [...here, "amplitude", k]));
    for (const name of others[part.type]) paths[first + name] = [...here, name];
  });
  if (table.activation) paths.activation_time = ["activation", "time"];
  for (const name of ["amplitude", "frequency", "phase"]) paths[`harmonic_${name}`] = ["harmonic", name];
  for (const name of ["P_w", "F_ext", "x_z"]) {
    if (table[name] !== undefined) paths[name] = typeof table[name] === "object" ? [name, "level"] : [name];
  }
  return paths;
}

export const valueAt = (table, path) => path.reduce((node, step) => node[step], table);
export const get = (table, name) => {
  const path = pathsOf(table)[name];
  return path ? valueAt(table, path) : 0;
};
export function put(table, path, value) {
  valueAt(table, path.slice(0, -1))[path[path.length - 1]] = value;
}
export function withValues(table, values) {
  const copy = structuredClone(table),
    paths = pathsOf(copy);
  for (const [name, value] of Object.entries(values)) if (paths[name]) put(copy, paths[name], value);
  return copy;
}

// Value and slope of an input or of an envelope at a time.
export function signalAt(signal, t) {
  if (typeof signal === "number") return [signal, 0];
  const { type, level, initial = 0, start } = signal;
  if (type === "Constant") return [level, 0];
  if (type === "SmoothStep") {
    const p = Math.min(Math.max((t - start) / signal.rise, 0), 1),
      height = level - initial;
    return [
      initial + height * p ** 4 * (35 - p * (84 - p * (70 - 20 * p))),
      (height * 140 * (p * (1 - p)) ** 3) / signal.rise,
    ];
  }
  if (type === "RampHold") {
    const { ramp, corner } = signal,
      slope = (level - initial) / (ramp - corner);
    const rounded = (s) => {
      const p = Math.max(s / corner, 0);
      return p < 1 ? [corner * p ** 4 * (2.5 - p * (3 - p)), p ** 3 * (10 - p * (15 - 6 * p))] : [s - 0.5 * corner, 1];
    };
    const [a, b] = [rounded(t - start), rounded(t - start - (ramp - corner))];
    return [initial + slope * (a[0] - b[0]), slope * (a[1] - b[1])];
  }
  if (type === "Decay") {
    const { final, time_constant } = signal,
      fade = Math.exp(-Math.max(t - start, 0) / time_constant);
    const slope = t > start ? (-2 * fade * (1 - fade)) / time_constant : 0;
    return [final + (level - final) * fade * (2 - fade), (level - final) * slope];
  }
  if (type === "Sampled") {
    const { breaks, coefficients } = signal,
      last = breaks.length - 1,
      x = Math.min(Math.max(t, breaks[0]), breaks[last]);
    let i = 0;
    while (i < last - 1 && breaks[i + 1] <= x) i++;
    let value = 0,
      slope = 0;
    for (const c of coefficients[i]) {
      slope = slope * (x - breaks[i]) + value;
      value = value * (x - breaks[i]) + c;
    }
    return [level * value, t < breaks[0] || t > breaks[last] ? 0 : level * slope];
  }
  throw new Error(`an input of the kind ${type} is not known here`);
}

// K_w0, K_z0, C_w0, C_z0.
export const baseOf = ({ muscle: m }) => [
  m.stiffness_w.k * m.stiffness_w.x_ref ** 2,
  m.stiffness_z.k * m.stiffness_z.x_ref ** 2,
  m.damping_w.c * m.damping_w.v_ref ** 2,
  m.damping_z.c * m.damping_z.v_ref ** 2,
];

// Forces of the muscle with its inputs held, their slopes, and the motion of each task.
export function mechanicsOf(table) {
  const m = table.muscle,
    [K, Z, C, D] = [m.stiffness_w, m.stiffness_z, m.damping_w, m.damping_z];
  const held = (name) => (table[name] === undefined ? 0 : signalAt(table[name], HOLD)[0]);
  const [P, F, X] = [held("P_w"), held("F_ext"), held("x_z")],
    literal = (m.argument ?? "literal") === "literal";
  const quadratic = (factor, reference, x) => factor * (reference ** 2 + x * x);
  const active = (x, v, u) => (quadratic(C.c, C.v_ref, v) + u[2]) * v + (quadratic(K.k, K.x_ref, x) + u[0]) * x;
  const passive = (x, v, xz, vz, u) => {
    const s = xz - x,
      r = vz - v;
    return (quadratic(D.c, D.v_ref, literal ? vz : r) + u[3]) * r + (quadratic(Z.k, Z.x_ref, literal ? xz : s) + u[1]) * s;
  };
  // Derivatives of the active force with respect to x_w, and of the passive one with respect to x_w and x_z, at rest.
  const activeSlope = (x) => K.k * (K.x_ref ** 2 + 3 * x * x);
  const passiveSlopes = (x, xz) => {
    const s = xz - x,
      toe = Z.k * (Z.x_ref ** 2 + 3 * s * s),
      stiffness = quadratic(Z.k, Z.x_ref, xz);
    return literal ? [-stiffness, stiffness + 2 * Z.k * xz * s] : [-toe, toe];
  };
  // PrescribedMotion: the velocity at which the passive force is -F, and its derivatives by x_w, u[1] and u[3].
  const velocity = (x, u) => {
    const s = X - x,
      stiffness = quadratic(Z.k, Z.x_ref, literal ? X : s) + u[1],
      force = F + stiffness * s;
    const damping = (v) => (literal ? D.c * D.v_ref ** 2 : D.c * (D.v_ref ** 2 + v * v)) + u[3];
    let v = force / damping(0);
    for (let i = 0; i < 60 && !literal; i++) {
      const step = (damping(v) * v - force) / (damping(v) + 2 * D.c * v * v);
      v -= step;
      if (Math.abs(step) <= 1e-14 * Math.abs(v)) break;
    }
    const slope = literal ? damping(0) : damping(v) + 2 * D.c * v * v;
    const stiff = literal ? stiffness : Z.k * (Z.x_ref ** 2 + 3 * s * s) + u[1];
    return { v, byX: -stiff / slope, byK: s / slope, byC: -v / slope };
  };
  const drive = (u) => P * (1 + u[4]);
  const kinds = {
    isometric: {
      start: () => [X + 1e-3, 0],
      field: ([x, v], u) => [v, (drive(u) - active(x, v, u) + passive(x, v, X, 0, u)) / m.m_w],
      output: ([x, v], u) => -passive(x, v, X, 0, u),
    },
    "prescribed-force": {
      start: () => [1e-3, 1e-3, 1e-3, 1e-3],
      field: ([x, v, xz, vz], u) => {
        const force = passive(x, v, xz, vz, u);
        return [v, (drive(u) - active(x, v, u) + force) / m.m_w, vz, -(F + force) / m.m_z];
      },
      output: (y, u) => (table.observe === "acceleration" ? -(F + passive(...y, u)) / m.m_z : y[2]),
    },
    "prescribed-motion": {
      start: () => [X + 1e-3],
      field: ([x], u) => [velocity(x, u).v],
      output: ([x], u, du) => {
        const { v, byX, byK, byC } = velocity(x, u);
        return m.m_w * (byX * v + byK * du[1] + byC * du[3]) + active(x, v, u) + F;
      },
    },
  };
  kinds["prescribed-length"] = kinds.isometric;
  return { ...kinds[table.task], P, F, X, activeSlope, passiveSlopes };
}

// Equilibrium by Newton's method; the derivatives at rest stand in `jacobian`.
function equilibrium(table, mechanics) {
  const still = [0, 0, 0, 0, 0];
  let y = mechanics.start();
  for (let i = 0; i < 200; i++) {
    const A = jacobian(table, mechanics, y),
      f = mechanics.field(
        y.map((x, k) => (table.task === "prescribed-motion" || k % 2 === 0 ? x : 0)),
        still,
      );
    const step = newtonStep(table, A, f);
    y = y.map((x, k) => (table.task !== "prescribed-motion" && k % 2 ? 0 : x - step[k]));
    if (step.every((s, k) => Math.abs(s) <= 1e-15 * Math.max(Math.abs(y[k]), 1e-9))) return y;
    if (!y.every(Number.isFinite)) break;
  }
  return y;
}

function newtonStep(table, A, f) {
  if (table.task === "prescribed-motion") return [f[0] / A[0][0]];
  if (table.task !== "prescribed-force") return [f[1] / A[1][0], 0];
  const [a, b, c, d] = [A[1][0], A[1][2], A[3][0], A[3][2]],
    det = a * d - b * c;
  return [(f[1] * d - b * f[3]) / det, 0, (a * f[3] - c * f[1]) / det, 0];
}

function jacobian(table, mechanics, y) {
  const { muscle: m, task } = table,
    [, , Cw, Cz] = baseOf(table);
  if (task === "prescribed-motion") return [[mechanics.passiveSlopes(y[0], mechanics.X)[0] / Cz]];
  const active = mechanics.activeSlope(y[0]);
  const [px, pz] = mechanics.passiveSlopes(y[0], task === "prescribed-force" ? y[2] : mechanics.X);
  const upper = [
    [0, 1],
    [(px - active) / m.m_w, -(Cw + Cz) / m.m_w],
  ];
  if (task !== "prescribed-force") return upper;
  return [
    [...upper[0], 0, 0],
    [...upper[1], pz / m.m_w, Cz / m.m_w],
    [0, 0, 0, 1],
    [-px / m.m_z, Cz / m.m_z, -pz / m.m_z, -Cz / m.m_z],
  ];
}

// y' = A (y - point) + B u, z = rest + C (y - point) + D u + E u': the task about its equilibrium.
export function linearise(table) {
  const mechanics = mechanicsOf(table),
    { muscle: m, task } = table,
    [, , Cw, Cz] = baseOf(table),
    none = [0, 0, 0, 0, 0];
  const point = equilibrium(table, mechanics),
    A = jacobian(table, mechanics, point),
    [x] = point;
  const rest = mechanics.output(point, none, none);
  if (task === "prescribed-motion") {
    const s = mechanics.X - x,
      a = A[0][0],
      byK = s / Cz;
    const C = [m.m_w * a * a + Cw * a + mechanics.activeSlope(x)];
    return {
      point,
      rest,
      A,
      B: [[0, byK, 0, 0, 0]],
      C,
      D: [x, (m.m_w * a + Cw) * byK, 0, 0, 0],
      E: [0, m.m_w * byK, 0, 0, 0],
    };
  }
  const force = task === "prescribed-force",
    s = (force ? point[2] : mechanics.X) - x,
    B = zeros(A.length, 5);
  B[1] = [-x / m.m_w, s / m.m_w, 0, 0, mechanics.P / m.m_w];
  if (!force)
    return { point, rest, A, B, C: [-mechanics.passiveSlopes(x, mechanics.X)[0], Cz], D: [0, -s, 0, 0, 0], E: none };
  B[3] = [0, -s / m.m_z, 0, 0, 0];
  const seen = table.observe === "acceleration";
  return { point, rest, A, B, C: seen ? [...A[3]] : [0, 0, 1, 0], D: seen ? [...B[3]] : none, E: none };
}

// Whether all eigenvalues have a negative real part: Routh and Hurwitz on the characteristic polynomial.
export function isStable(A) {
  if (!A.flat().every(Number.isFinite)) return false;
  const n = A.length,
    a = [1];
  let M = A.map((row, i) => row.map((_, j) => (i === j ? 1 : 0)));
  for (let k = 1; k <= n; k++) {
    const AM = A.map((row) => M[0].map((_, j) => row.reduce((sum, x, i) => sum + x * M[i][j], 0)));
    a.push(-AM.reduce((sum, row, i) => sum + row[i], 0) / k);
    M = AM.map((row, i) => row.map((x, j) => x + (i === j ? a[k] : 0)));
  }
  const tiny = 1e-12,
    positive = a.every((x) => x > 0);
  if (n < 3) return positive;
  const inner = a[1] * a[2] * a[3] - a[3] ** 2 - a[1] ** 2 * a[4]; // n = 4
  return positive && inner > tiny * a[1] * a[2] * a[3];
}
