// Figures as SVG: the spectrum with its residuals, and a trace.

const SUPERSCRIPT = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
const power10 = (k) => (k === 0 ? "1" : `10${[...String(k)].map((c) => SUPERSCRIPT[c]).join("")}`);
const rounded = (x) => x.toFixed(1);
const path = (points) => points.map(([x, y], i) => `${i ? "L" : "M"}${rounded(x)},${rounded(y)}`).join("");

function ticks(low, high, about) {
  const raw = (high - low) / about,
    unit = 10 ** Math.floor(Math.log10(raw)),
    step = [1, 2, 5, 10].map((k) => k * unit).find((k) => k >= raw);
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, i) =>
    Number(((first + i) * step).toPrecision(12)),
  );
}

// {frequency, power, line, target: {frequency, power, sd, residuals} | null, run: powers | null, label, logFrequency}
export function drawSpectrum(svg, { frequency, power, line, target, run, label, logFrequency }) {
  const width = Math.max(svg.parentElement.clientWidth, 240),
    small = width < 500,
    left = 52,
    right = width - 12,
    lower = target ? 66 : 0;
  const height = (small ? 216 : 330) + lower * (small ? 0.75 : 1),
    top = small ? 34 : 20,
    legend = small ? 28 : 13,
    foot = height - 34,
    bottom = target ? foot - lower * (small ? 0.75 : 1) : foot;
  const all = [...power, ...(target ? target.power : [])].filter((p) => p > 0),
    largest = Math.max(...all);
  const ceiling = Math.log10(largest) + 0.15,
    floor = Math.max(Math.min(Math.log10(Math.min(...all)) - 0.15, ceiling - 1.7), ceiling - 7);
  const across = logFrequency ? Math.log : (f) => f,
    f0 = logFrequency ? frequency.find((f) => f > 0) * 0.9 : 0,
    f1 = frequency[frequency.length - 1] * (logFrequency ? 1.05 : 1.02);
  const x = (f) => left + ((across(f) - across(f0)) / (across(f1) - across(f0))) * (right - left);
  const y = (p) =>
    top + ((ceiling - Math.max(Math.log10(Math.max(p, 1e-300)), floor - 0.5)) / (ceiling - floor)) * (bottom - top);
  const parts = [`<title id="figure-title">Power spectrum, ${label}, over frequency in Hz</title>`];
  for (let k = Math.ceil(floor); k <= ceiling; k++) {
    parts.push(
      `<path class="grid" d="M${left},${rounded(y(10 ** k))}H${right}"/><text x="${left - 6}" y="${rounded(y(10 ** k) + 4)}" text-anchor="end">${power10(k)}</text>`,
    );
  }
  const marks = logFrequency
    ? [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].filter((f) => f >= f0 && f <= f1)
    : ticks(f0, f1, small ? 5 : 9);
  for (const f of marks)
    parts.push(
      `<path class="grid" d="M${rounded(x(f))},${top}V${foot}"/><text x="${rounded(x(f))}" y="${foot + 15}" text-anchor="middle">${f}</text>`,
    );
  parts.push(`<path class="axis" d="M${left},${top}V${bottom}H${right}"/>`);
  parts.push(
    `<text x="${(left + right) / 2}" y="${height - 4}" text-anchor="middle">frequency [Hz]</text><text x="${left}" y="13">${label}</text>`,
  );
  const curve = (values) =>
    path(frequency.flatMap((f, k) => (f > 0 || !logFrequency ? [[x(f), Math.min(y(values[k]), bottom + 9)]] : [])));
  const inside = `<clipPath id="inside"><rect x="${left}" y="${top}" width="${right - left}" height="${rounded(bottom - top - 1)}"/></clipPath>`;
  parts.push(inside);
  if (run) parts.push(`<path clip-path="url(#inside)" class="run" d="${curve(run)}"/>`);
  if (line.some((p) => p > 0)) parts.push(`<path clip-path="url(#inside)" class="harmonic" d="${curve(line)}"/>`);
  parts.push(`<path clip-path="url(#inside)" class="model" d="${curve(power)}"/>`);
  const names = [
    ["model", "model"],
    ...(line.some((p) => p > 0) ? [["harmonic", "harmonic"]] : []),
    ...(run ? [["run", "one trace"]] : []),
    ...(target ? [["datum", "data"]] : []),
  ];
  let at = right;
  for (const [kind, name] of names.reverse()) {
    at -= 7 * name.length + 8;
    parts.push(`<text x="${at}" y="${legend}">${name}</text>`);
    at -= 22;
    parts.push(
      kind === "datum"
        ? `<circle class="datum" cx="${at + 14}" cy="${legend - 4}" r="3"/>`
        : `<path class="${kind}" d="M${at},${legend - 4}h18"/>`,
    );
    at -= 6;
  }
  if (target) {
    const middle = (bottom + foot) / 2 + 6,
      half = (foot - bottom) / 2 - 8,
      most = Math.max(3, ...target.residuals.map(Math.abs));
    parts.push(
      `<path class="axis" d="M${left},${middle}H${right}"/><text x="${left - 6}" y="${middle + 4}" text-anchor="end">0 sd</text>`,
    );
    target.frequency.forEach((f, k) => {
      const [up, down] = [1, -1].map((s) => y(target.power[k] * Math.exp(s * target.sd[k]))),
        r = target.residuals[k];
      if (target.known) parts.push(`<path class="bar" d="M${rounded(x(f))},${rounded(up)}V${rounded(down)}"/>`);
      parts.push(`<circle class="datum" cx="${rounded(x(f))}" cy="${rounded(y(target.power[k]))}" r="2.8"/>`);
      parts.push(
        `<circle class="datum${target.known && Math.abs(r) > 3 ? " beyond" : ""}" cx="${rounded(x(f))}" cy="${rounded(middle - (r / most) * half)}" r="2.2"/>`,
      );
    });
  }
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.innerHTML = parts.join("");
}

// Samples over time, from `from` s on.
export function drawTrace(svg, values, interval, from, label) {
  const width = Math.max(svg.parentElement.clientWidth, 240),
    height = 150,
    left = 62,
    right = width - 12,
    top = 20,
    bottom = height - 32;
  const low = Math.min(...values),
    high = Math.max(...values),
    spread = high - low || 1,
    last = from + (values.length - 1) * interval;
  const x = (t) => left + ((t - from) / (last - from)) * (right - left),
    y = (v) => bottom - ((v - low) / spread) * (bottom - top);
  const parts = [
    `<text x="${left}" y="13">${label}</text><text x="${(left + right) / 2}" y="${height - 3}" text-anchor="middle">time [s]</text>`,
  ];
  for (const v of ticks(low, high, 3))
    parts.push(
      `<path class="grid" d="M${left},${rounded(y(v))}H${right}"/><text x="${left - 6}" y="${rounded(y(v) + 4)}" text-anchor="end">${Number(v.toPrecision(6))}</text>`,
    );
  for (const t of ticks(from, last, 6))
    parts.push(`<text x="${rounded(x(t))}" y="${bottom + 15}" text-anchor="middle">${t}</text>`);
  parts.push(
    `<path class="axis" d="M${left},${top}V${bottom}H${right}"/><path class="run" d="${path([...values].map((v, k) => [x(from + k * interval), y(v)]))}"/>`,
  );
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.innerHTML = parts.join("");
}
