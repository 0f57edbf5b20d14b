// The expected Welch spectrum of a task in linear response, in closed form: what jaxmuscle.expected_spectrum computes.
import { dot } from "./numbers.mjs";
import { lagWeights, samplesIn, spreadOf } from "./settings.mjs";
import { isStable, linearise } from "./task.mjs";
import { covariances, lagged, convolvedAt } from "./covariance.mjs";
import { harmonicLine } from "./harmonic.mjs";

// {power, line, components, mean, variance, system}; an Error says why there is no linear response.
export function expectedSpectrum(table, settings = table.settings) {
  const system = linearise(table);
  if (!system.point.every(Number.isFinite))
    throw new Error("There is no equilibrium: a stiffness must balance the forces. Raise k_w or x_ref_w.");
  if (!isStable(system.A))
    throw new Error("The equilibrium is unstable or not damped, so there is no expected spectrum. Raise c_w, c_z or k_w.");
  const weights = lagWeights(settings),
    spread = spreadOf(settings),
    samples = samplesIn(settings),
    reach = spread.length - 1;
  const lags = Math.max(settings.length + reach, samples, reach + 1),
    own = covariances(table, system),
    sum = new Float64Array(lags);
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
  const rho = (j) => spread[Math.abs(j)] ?? 0,
    reach = spread.length - 1;
  for (let l = 0; l < reach; l++) {
    // what the low-pass takes off the variance of the mean
    let lowered = -l;
    for (let j = -reach; j <= reach; j++) lowered += rho(j) * Math.abs(l - j);
    slow -= (l ? 2 : 1) * lowered * r[l];
  }
  return convolvedAt(r, spread, 0) - slow / samples ** 2;
}
