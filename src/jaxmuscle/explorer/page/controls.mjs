// Sliders with their numbers: one row for each parameter of the task.
import { get, pathsOf } from "./task.mjs";

const GROUPS = [
  ["Muscle", ["k_w", "k_z", "c_w", "c_z", "m_w", "m_z"]],
  ["Held inputs", ["P_w", "F_ext", "x_z"]],
  ["Noise", ["noise_K_w", "noise_K_z", "noise_C_w", "noise_C_z", "noise_P_w", "noise_cutoff", "noise_correlation_time"]],
  ["Harmonic", ["harmonic_amplitude", "harmonic_frequency", "harmonic_phase"]],
  [
    "Activation and tremor",
    [
      "activation_time",
      "resonance_amplitude",
      "resonance_frequency",
      "resonance_width",
      "resonance_2_amplitude",
      "resonance_2_frequency",
      "resonance_2_width",
    ],
  ],
  ["Where the muscle is linear", ["x_ref_w", "x_ref_z", "v_ref_w", "v_ref_z"]],
];
const POSITIONS = 1000;

export const unitOf = (unit) => (unit === "1" ? "" : unit.replaceAll("^3", "³").replaceAll("^2", "²"));

// Between a value and the place of its slider. A logarithmic one that may be 0 has 0 at its left end.
export function scaleOf(row, value) {
  const [low, high] = [Math.min(row.low, value || row.low), Math.max(row.high, value || row.high)],
    off = row.off ? 1 : 0;
  if (!row.positive) {
    return { place: (v) => ((v - low) / (high - low)) * POSITIONS, value: (p) => low + (p / POSITIONS) * (high - low) };
  }
  const ratio = Math.log(high / row.low),
    from = row.low;
  return {
    place: (v) => (v <= 0 ? 0 : Math.min(Math.max(off + ((POSITIONS - off) * Math.log(v / from)) / ratio, off), POSITIONS)),
    value: (p) => (off && p < 1 ? 0 : from * Math.exp((ratio * (p - off)) / (POSITIONS - off))),
  };
}

// Makes the rows; `change(name, value, done)` is called while a slider moves (done false) and when it is released.
export function makeRows(box, table, parameters, change) {
  const known = pathsOf(table);
  box.replaceChildren(
    ...GROUPS.flatMap(([title, names]) => {
      const rows = names.filter((name) => known[name]).map((name) => makeRow(name, parameters[name], change));
      if (!rows.length) return [];
      const set = document.createElement("fieldset"),
        legend = document.createElement("legend");
      legend.textContent = title;
      set.append(legend, ...rows);
      return [set];
    }),
  );
}

function makeRow(name, row, change) {
  const line = document.createElement("div");
  line.className = "row";
  line.dataset.name = name;
  line.innerHTML = `<label for="slider-${name}"><span class="meaning"></span><span class="symbol"><i></i> <span class="unit"></span></span></label>
    <input type="range" id="slider-${name}" min="0" max="${POSITIONS}" step="1">
    <input type="number" id="${name}" step="any" inputmode="decimal">`;
  const [slider, number] = line.querySelectorAll("input");
  line.querySelector(".meaning").textContent = row.meaning;
  line.querySelector(".symbol i").textContent = name;
  line.querySelector(".unit").textContent = row.unit === "1" ? "" : `[${unitOf(row.unit)}]`;
  number.setAttribute("aria-label", `${row.meaning}, ${name}${row.unit === "1" ? "" : `, in ${row.unit}`}`);
  const moved = () => Number(slider.scale.value(Number(slider.value)).toPrecision(4));
  slider.addEventListener("input", () => change(name, moved(), false));
  slider.addEventListener("change", () => change(name, moved(), true));
  number.addEventListener("change", () => change(name, number.value === "" ? NaN : Number(number.value), true));
  return line;
}

// Puts the values of a task into the rows, but for the slider that is being moved.
export function showRows(box, table, parameters, moving) {
  for (const line of box.querySelectorAll(".row")) {
    const name = line.dataset.name,
      row = parameters[name],
      value = get(table, name),
      [slider, number] = line.querySelectorAll("input");
    if (name !== moving) {
      slider.scale = scaleOf(row, value);
      slider.value = slider.scale.place(value);
    }
    slider.setAttribute(
      "aria-valuetext",
      value === 0 && row.off ? "off" : `${Number(value.toPrecision(4))} ${unitOf(row.unit)}`,
    );
    number.value = Number(value.toPrecision(7));
  }
}
