// Noises as linear filters of white noise: q' = F q + G w, N = H q + L w.
import { ellipticK, ellipticTangent } from "./numbers.mjs";

const POINTS = 2000,
  TOLERANCE = 0.05;

const diagonal = (values) => values.map((value, i) => values.map((_, j) => (i === j ? value : 0)));

export function shapingFilter(part) {
  const tau = 2 * Math.PI;
  if (part.type === "WhiteNoise") return { F: [], G: [], H: [], L: [1 / Math.sqrt(part.rate)] };
  if (part.type === "BandLimitedNoise") {
    const w = tau * part.cutoff;
    return {
      F: [
        [0, w],
        [-w, -Math.SQRT2 * w],
      ],
      G: [[0], [w / Math.sqrt(part.rate)]],
      H: [1, 0],
      L: [0],
    };
  }
  if (part.type === "OrnsteinUhlenbeckNoise") {
    const rate = 1 / part.correlation_time;
    return { F: [[-rate]], G: [[Math.sqrt(2 * rate)]], H: [1], L: [0] };
  }
  if (part.type === "ResonantNoise") {
    const w = tau * part.frequency,
      rate = tau * part.width;
    return {
      F: [
        [0, w],
        [-w, -rate],
      ],
      G: [[0], [Math.sqrt(2 * rate)]],
      H: [0, 1],
      L: [0],
    };
  }
  if (part.type === "PinkNoise") {
    const { corners, shares } = pinkStates(part.f_low, part.f_high),
      rates = corners.map((f) => tau * f);
    return {
      F: diagonal(rates.map((x) => -x)),
      G: diagonal(rates.map((x) => Math.sqrt(2 * x))),
      H: shares.map(Math.sqrt),
      L: rates.map(() => 0),
    };
  }
  throw new Error(`a noise of the kind ${part.type} is not known here`);
}

// Corner frequencies and shares of the states whose density is nearest to 1/f: Zolotarev's rational function.
function zolotarev(low, high, count) {
  const m1 = (low / high) ** 2,
    K = ellipticK(m1);
  const half = Array.from({ length: count }, (_, i) => (low / high) * ellipticTangent((K * (i + 1)) / (2 * count), m1) ** 2);
  const points = [
    ...half,
    ...half
      .slice(0, -1)
      .reverse()
      .map((x) => 1 / x),
  ];
  const poles = points.filter((_, i) => i % 2 === 0),
    zeros = points.filter((_, i) => i % 2 === 1);
  const shares = poles.map((pole, i) => {
    const above = zeros.reduce((all, zero) => all * (zero - pole), 1);
    const below = poles.reduce((all, other, j) => (j === i ? all : all * (other - pole)), 1);
    return above / below / Math.sqrt(pole);
  });
  const sum = shares.reduce((a, b) => a + b, 0);
  return { corners: poles.map((pole) => Math.sqrt(low * high * pole)), shares: shares.map((x) => x / sum) };
}

function deviation({ corners, shares }, low, high) {
  const count = POINTS * corners.length + 1;
  const level = Array.from({ length: count }, (_, i) => {
    const f = low * (high / low) ** (i / (count - 1));
    return Math.log(f * corners.reduce((sum, c, k) => sum + shares[k] / (Math.PI * c) / (1 + (f / c) ** 2), 0));
  });
  const mean = level.reduce((a, b) => a + b, 0) / count;
  return level.reduce((most, x) => Math.max(most, Math.abs(x - mean)), 0);
}

const known = new Map();

export function pinkStates(low, high) {
  const key = `${low} ${high}`;
  if (!known.has(key)) {
    let count = 1;
    while (deviation(zolotarev(low, high, count), low, high) > TOLERANCE) count++;
    known.set(key, zolotarev(low, high, count));
  }
  return known.get(key);
}
