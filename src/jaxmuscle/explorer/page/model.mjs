// Changes of a task as a whole: another task, another noise, additions; and what the package refuses.
import { ACTIVE, INPUTS, actsOn, componentsOf, pathsOf } from "./task.mjs";

const COMMON = ["muscle", "noise", "harmonic", "activation", "settings"];

export const resonancesOf = (table) => componentsOf(table).filter((part) => part.type === "ResonantNoise");
const coloured = (table) => componentsOf(table).filter((part) => part.type !== "ResonantNoise");
const needed = (table, facts) => [
  ...facts.smoothness_needed[
    table.task === "prescribed-force" ? `prescribed-force ${table.observe ?? "displacement"}` : table.task
  ],
  0,
];

function withComponents(table, parts) {
  return { ...table, noise: parts.length === 1 ? parts[0] : { type: "NoiseSum", parts } };
}

// The same muscle, perturbation and settings in another task.
export function asTask(table, name, facts) {
  const kept = Object.fromEntries(COMMON.filter((key) => table[key] !== undefined).map((key) => [key, table[key]]));
  return structuredClone({ ...facts.tasks[name], ...kept, task: name });
}

export const noiseOf = (table, facts) =>
  Object.keys(facts.noises).find((name) => facts.noises[name].type === coloured(table)[0]?.type) ?? "";

export function withNoise(table, name, facts) {
  const drive = hasDrive(table),
    found = withComponents(table, [structuredClone(facts.noises[name]), ...resonancesOf(table)]);
  return drive ? withDrive(found, true, facts) : found;
}

export const hasDrive = (table) => coloured(table).some((part) => part.amplitude.length === 5);

export function withDrive(table, on, facts) {
  const parts = structuredClone(componentsOf(table)),
    part = parts.find((each) => each.type !== "ResonantNoise" && each.amplitude.length > 1);
  if (part)
    part.amplitude = on ? [...part.amplitude.slice(0, 4), facts.parameters.noise_P_w.default] : part.amplitude.slice(0, 4);
  return withComponents(table, parts);
}

export function withResonances(table, count, facts) {
  const more = facts.resonances.slice(resonancesOf(table).length, count).map((part) => structuredClone(part));
  return withComponents(table, [...coloured(table), ...resonancesOf(table).slice(0, count), ...more]);
}

export function withActivation(table, on, facts) {
  const { activation, ...rest } = table;
  return on
    ? { ...rest, activation: activation ?? { type: "Activation", time: facts.parameters.activation_time.default } }
    : rest;
}

// The task of a preset file or of a fit.json; an Error says what of it is not known here.
export function taskIn(table, file, facts) {
  if (!table) throw new Error(`${file} has no task_table: it is neither a preset nor a fit.json.`);
  if (!facts.tasks[table.task]) throw new Error(`${file}: there is no task "${table.task}".`);
  const known = facts.tasks.isometric.muscle,
    kindsOf = (muscle) =>
      [muscle, muscle?.stiffness_w, muscle?.stiffness_z, muscle?.damping_w, muscle?.damping_z].map((x) => x?.type);
  if (kindsOf(table.muscle).join() !== kindsOf(known).join()) {
    throw new Error(`${file}: its muscle or one of its laws is not that of the paper, which alone is known here.`);
  }
  return Object.fromEntries(Object.entries(table).filter(([, part]) => part !== "none"));
}

// Channels of a noise that is rougher than the task allows, as {part, j, name, needs}.
function refused(table, facts) {
  const need = needed(table, facts);
  return componentsOf(table).flatMap((part) =>
    actsOn(part).flatMap((input, j) => {
      const have = facts.smoothness[part.type] + (table.activation && ACTIVE.includes(input) ? 2 : 0);
      return have < need[input] && part.amplitude[j] !== 0 ? [{ part, j, name: INPUTS[input], type: part.type }] : [];
    }),
  );
}

// The table with such channels off, and their names.
export function allowed(table, facts) {
  const copy = structuredClone(table),
    off = refused(copy, facts);
  for (const { part, j } of off) part.amplitude[j] = 0;
  return { table: copy, off: off.map(({ name }) => name) };
}

// Why the package would refuse this task; null if it would not.
export function refusal(table, facts) {
  const rough = refused(table, facts);
  if (rough.length)
    return `${rough[0].type} on ${rough[0].name} is too rough for this task. Set noise_${rough[0].name} to 0, or take band-limited noise.`;
  const { amplitude, frequency } = table.harmonic,
    half = table.settings.rate / 2;
  if (amplitude > 0 && frequency >= half) return `The harmonic must lie below half the sampling rate, ${half} Hz.`;
  const silent = amplitude === 0 && componentsOf(table).every((part) => part.amplitude.every((a) => a === 0));
  return silent ? "There is neither noise nor a harmonic, so the spectrum is zero. Raise noise_K_w." : null;
}

// Bounds of a parameter that the package checks; null if the value is good.
export function outOfBounds(name, value, facts) {
  const { lower, upper, unit } = facts.parameters[name];
  if (!Number.isFinite(value)) return `${name}: give a number.`;
  if ((lower !== null && value < lower) || (upper !== null && value > upper))
    return `${name} = ${value} ${unit} is outside of its bounds.`;
  const strict =
    /^(m_[wz]|noise_cutoff|noise_correlation_time|harmonic_frequency|activation_time|resonance(_2)?_(frequency|width))$/;
  return value === 0 && strict.test(name) ? `${name} must be larger than 0.` : null;
}

// Parameters that a fit usually frees, as far as this task has them and they are not 0.
export const usuallyFree = (table, facts, get) =>
  facts.usually_free.filter((name) => pathsOf(table)[name] && get(table, name) !== 0);
