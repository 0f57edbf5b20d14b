// The harmonic's line in a Welch spectrum, in linear response.
import { apply, blocks, dot, expm, eye, outer, scaledBy, solve, zeros } from "./numbers.mjs";
import {
  FINER,
  WINDOW,
  antiAlias,
  binRows,
  lowpass,
  lowpassGain,
  samplesIn,
  segmentsIn,
  stepOf,
  welch,
} from "./settings.mjs";
import { ACTIVE, baseOf, signalAt } from "./task.mjs";
import { activationStates } from "./covariance.mjs";

// The response to one signal that acts on every input by so much, through the activation where that is: y' = A y + b h.
function signalSystem(table, system, base) {
  const on = table.activation ? ACTIVE : [],
    later = base.map((x, i) => (on.includes(i) ? x : 0)),
    now = base.map((x, i) => x - later[i]);
  const own = { b: apply(system.B, now), d: dot(system.D, now), e: dot(system.E, now) };
  if (!table.activation) return { A: system.A, c: system.C, ...own };
  const [F, into] = activationStates(table.activation.time),
    n = system.A.length,
    d = dot(system.D, later),
    e = dot(system.E, later);
  return {
    A: blocks(system.A, outer(apply(system.B, later), [1, 0]), zeros(2, n), F),
    b: [...own.b, ...into],
    c: [...system.C, d + e * F[0][0], e * F[0][1]],
    d: own.d,
    e: own.e,
  };
}

// c (iω - A)⁻¹ b + d + iω e, as [re, im].
function transfer({ A, b, c, d, e }, omega) {
  const n = A.length,
    minus = scaledBy(A, -1),
    turn = eye(n).map((row) => row.map((x) => omega * x));
  const x = solve(blocks(minus, scaledBy(turn, -1), turn, minus), [...b.map((v) => [v]), ...b.map(() => [0])]).map(
    (row) => row[0],
  );
  return [dot(c, x.slice(0, n)) + d, dot(c, x.slice(n)) + omega * e];
}

const times = ([a, b], [c, d]) => [a * c - b * d, a * d + b * c];
const turned = (angle) => [Math.cos(angle), Math.sin(angle)];

// What sampling makes of a line that turns by `angle` in an interval.
function sampledGain(angle, sampling) {
  if (sampling === "average") return [Math.sin(angle) / angle, (Math.cos(angle) - 1) / angle];
  if (sampling !== "filtered") return [1, 0];
  const taps = antiAlias(FINER),
    centre = (taps.length - 1) / 2;
  return [taps.reduce((sum, x, i) => sum + x * Math.cos((angle * (i - centre)) / FINER), 0), 0];
}

const harmonicBase = (table) => [...baseOf(table).slice(0, 2), 0, 0, 0];

// Welch power of the harmonic, phase and leakage included, and its variance in the window.
export function harmonicLine(table, system, settings) {
  const h = table.harmonic,
    level = h.envelope.type === "Constant" ? h.envelope.level : null;
  if (h.amplitude === 0) return { power: binRows(settings).map(() => 0), variance: 0 };
  if (level === null) return envelopedLine(table, system, settings);
  const omega = 2 * Math.PI * h.frequency,
    angle = omega / settings.rate,
    n = settings.length;
  const through = times(sampledGain(angle, settings.sampling), lowpassGain(settings, angle));
  const size = h.amplitude * level;
  const reply = times(times(transfer(signalSystem(table, system, harmonicBase(table)), omega), turned(h.phase)), [size, 0]);
  const samples = samplesIn(settings),
    start = Math.round(WINDOW[0] * settings.rate),
    count = segmentsIn(settings, samples);
  const line = times(times(reply, reply), times(through, through)); // (r g)²
  const strength = Math.hypot(...line);
  let twice = [0, 0];
  for (let k = 0; k < count; k++) {
    const t = turned(2 * angle * (start + k * stepOf(settings)));
    twice = [twice[0] + t[0] / count, twice[1] + t[1] / count];
  }
  const cos = Float64Array.from({ length: n }, (_, m) => Math.cos(angle * m)),
    sin = Float64Array.from({ length: n }, (_, m) => Math.sin(angle * m));
  const power = binRows(settings).map((tapers) => {
    let level = 0,
      both = [0, 0];
    for (const { re, im } of tapers) {
      let cc = 0,
        cs = 0,
        sc = 0,
        ss = 0;
      for (let m = 0; m < n; m++) {
        cc += re[m] * cos[m];
        cs += re[m] * sin[m];
        sc += im[m] * cos[m];
        ss += im[m] * sin[m];
      }
      const ahead = [cc - ss, cs + sc],
        behind = [cc + ss, sc - cs];
      level += ahead[0] ** 2 + ahead[1] ** 2 + behind[0] ** 2 + behind[1] ** 2;
      const cross = times(ahead, [behind[0], -behind[1]]);
      both = [both[0] + cross[0], both[1] + cross[1]];
    }
    return Math.max(0.25 * strength * level - 0.5 * times(line, times(twice, both))[0], 0);
  });
  const mean = (k) => {
    // of exp(i k angle m) over the samples of the window
    const half = (k * angle) / 2,
      ratio = Math.abs(Math.sin(half)) < 1e-300 ? 1 : Math.sin(samples * half) / (samples * Math.sin(half));
    return times(turned(k * angle * (start + (samples - 1) / 2)), [ratio, 0]);
  };
  const once = times(times(reply, through), mean(1))[1];
  return { power, variance: 0.5 * (strength - times(line, mean(2))[0]) - once ** 2 };
}

// The same for an envelope that changes: stepped exactly in the frame that turns with the harmonic, from the steady state.
function envelopedLine(table, system, settings) {
  const h = table.harmonic,
    { A, b, c, d, e } = signalSystem(table, system, harmonicBase(table)),
    n = A.length;
  const omega = 2 * Math.PI * h.frequency,
    interval = 1 / settings.rate,
    stop = Math.round(WINDOW[1] * settings.rate);
  const turn = scaledBy(eye(n), omega),
    M = blocks(A, turn, scaledBy(turn, -1), A),
    N = 2 * n; // real and imaginary part of (A - iω)
  const drive = [...b, ...b.map(() => 0)],
    whole = zeros(N + 2, N + 2);
  for (let i = 0; i < N; i++) {
    for (let j = 0; j < N; j++) whole[i][j] = M[i][j] * interval;
    whole[i][N] = drive[i] * interval;
  }
  whole[N][N + 1] = 1;
  const E = expm(whole),
    Phi = E.slice(0, N).map((row) => row.slice(0, N)),
    held = E.slice(0, N).map((row) => row[N]),
    ramp = E.slice(0, N).map((row) => row[N + 1]);
  const levels = Array.from({ length: stop }, (_, i) => signalAt(h.envelope, i * interval));
  let Y = solve(
    M,
    drive.map((x) => [-x * levels[0][0]]),
  ).map((row) => row[0]);
  const gain = sampledGain(omega * interval, settings.sampling),
    z = new Float64Array(stop);
  for (let i = 0; i < stop; i++) {
    if (i) Y = apply(Phi, Y).map((x, k) => x + held[k] * levels[i - 1][0] + ramp[k] * (levels[i][0] - levels[i - 1][0]));
    const [a, slope] = levels[i],
      inside = [dot(c, Y.slice(0, n)) + d * a + e * slope, dot(c, Y.slice(n)) + e * omega * a];
    z[i] = h.amplitude * times(inside, times(turned(omega * interval * i + h.phase), gain))[1];
  }
  const seen = lowpass(settings, z).slice(Math.round(WINDOW[0] * settings.rate)),
    mean = seen.reduce((a, b) => a + b, 0) / seen.length;
  return { power: welch(settings, seen), variance: seen.reduce((sum, x) => sum + (x - mean) ** 2, 0) / seen.length };
}
