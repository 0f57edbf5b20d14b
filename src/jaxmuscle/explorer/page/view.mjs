// What the page shows of a spectrum and of a trace: figures and numbers.
import { baseOf } from "./task.mjs";
import { WINDOW, frequencies, lowpass, samplesIn, segmentsIn, welch } from "./settings.mjs";
import { compared } from "./statistics.mjs";
import { simulate } from "./simulate.mjs";
import { drawSpectrum, drawTrace } from "./figure.mjs";

export const $ = (id) => document.getElementById(id);
export const digits = (x, n = 4) =>
  x !== 0 && (Math.abs(x) >= 1e5 || Math.abs(x) < 1e-3) ? x.toExponential(n - 2) : String(Number(x.toPrecision(n)));
const OUTPUTS = {
  "prescribed-motion": ["force P_w", "N"],
  "prescribed-force": ["displacement x_z", "m"],
  acceleration: ["acceleration of the insertion", "m/s²"],
};
const outputOf = (table) => OUTPUTS[table.observe === "acceleration" ? "acceleration" : table.task] ?? ["force F_ext", "N"];

// The spectrum over its target if there is one, with its numbers; chi² per bin, or null.
export function showSpectrum(state, seen) {
  const { table, target } = state,
    settings = table.settings;
  const sum = seen.power.reduce((a, b) => a + b, 0),
    match = target ? compared(target, settings, seen) : null;
  const density = $("power").value !== "",
    fittedSum = target ? target.bins.reduce((all, k) => all + seen.power[k - settings.first_bin], 0) : sum;
  const scale = density ? 1 : 1 / fittedSum,
    [name, unit] = outputOf(table);
  const run = showTrace(state);
  drawSpectrum($("figure"), {
    frequency: frequencies(settings),
    power: seen.power.map((p) => p * scale),
    line: seen.line.map((p) => p * scale),
    target: match && {
      frequency: target.frequency,
      sd: match.sd,
      residuals: match.residuals,
      known: match.chi2 !== null,
      power: target.proportional_power.map(
        (p, k) => (p * fittedSum * scale) / (match.chi2 === null ? 1 : Math.exp(match.bias[k])),
      ),
    },
    run: run && run.power.map((p) => p * (density ? 1 : 1 / run.power.reduce((a, b) => a + b, 0))),
    label: density ? `power [(${unit})²/Hz]` : "share of the power",
    logFrequency: $("log-frequency").checked,
  });
  const base = baseOf(table),
    top = seen.power.indexOf(Math.max(...seen.power)),
    sd = Math.sqrt(seen.variance),
    // of a target without a mean in newtons nobody knows the scale of force
    relative = target && unit === "N" && !target.newtons,
    own = (value) => digits(relative ? value / seen.mean : value, 3);
  const [stiffness, damping] = relative ? ["1/m", "s/m"] : ["N/m", "N s/m"],
    whose = relative ? ", per newton of mean force" : "";
  const numbers = [
    ["chi² per bin", match ? (match.chi2 === null ? "unknown: give segments" : digits(match.chi2, 3)) : "no data"],
    ["bins", target ? `${target.bins.length} of ${seen.power.length}` : `${seen.power.length}`],
    ...(relative
      ? []
      : [
          [`mean ${name}`, `${digits(seen.mean)} ${unit}`],
          ["standard deviation", `${digits(sd, 3)} ${unit}`],
        ]),
    [
      "coefficient of variation",
      Math.abs(seen.mean) > 1e-9 * sd ? `${digits((100 * sd) / Math.abs(seen.mean), 3)} %` : "mean is 0",
    ],
    ["maximum at", `${digits(frequencies(settings)[top], 3)} Hz`],
    [`stiffness at rest K_w0, K_z0${whose}`, `${own(base[0])}, ${own(base[1])} ${stiffness}`],
    [`damping at rest C_w0, C_z0${whose}`, `${own(base[2])}, ${own(base[3])} ${damping}`],
  ];
  $("numbers").replaceChildren(
    ...numbers.map(([key, value]) => {
      const pair = document.createElement("div"),
        dt = document.createElement("dt"),
        dd = document.createElement("dd");
      dt.textContent = key;
      dd.textContent = value;
      pair.append(dt, dd);
      return pair;
    }),
  );
  return match?.chi2 ?? null;
}

// A trace if one is wanted; its Welch power, or null.
function showTrace(state) {
  $("trace-figure").toggleAttribute("hidden", !state.trace);
  $("trace-hint").textContent = state.trace
    ? ""
    : "One recording of 15 s from the model, by Heun's method. Its last 10 s and their spectrum are drawn.";
  if (!state.trace) return null;
  try {
    const s = state.table.settings,
      { output } = simulate(state.table, { seed: state.seed, linear: state.linear });
    const from = Math.round(WINDOW[0] * s.rate),
      seen = lowpass(s, output).slice(from, from + samplesIn(s)),
      [name, unit] = outputOf(state.table);
    drawTrace($("trace-figure"), seen, 1 / s.rate, WINDOW[0], `${name} [${unit}]`);
    const mean = seen.reduce((a, b) => a + b, 0) / seen.length,
      variance = seen.reduce((a, v) => a + (v - mean) ** 2, 0) / seen.length;
    $("trace-hint").textContent =
      `Mean ${digits(mean)} ${unit}, standard deviation ${digits(Math.sqrt(variance), 3)} ${unit}. Seed ${state.seed} gives other numbers here than in Python.`;
    return segmentsIn(s, seen.length) ? { power: welch(s, seen) } : null;
  } catch (error) {
    $("trace-hint").textContent = error.message;
    return null;
  }
}
