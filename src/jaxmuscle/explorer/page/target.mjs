// A target from a CSV, as jaxmuscle.load_target reads one: frequency_hz,proportional_power[,sigma], # begins a comment.

const GRID_TOLERANCE = 0.02,
  PIXEL_TOLERANCE = 0.1,
  REACH = 0.1,
  COARSE = 1.1,
  NAMES = ["frequency_hz", "proportional_power", "sigma"];

const numberIn = (cell, comma) => Number(comma ? cell.replace(",", ".") : cell);
const isNumber = (cell, comma) => cell !== "" && Number.isFinite(numberIn(cell, comma));

// {name, bins, frequency, proportional_power, sigma, segments, notices}; an Error names the line.
export function readTarget(text, name, settings, segments) {
  const lines = text
    .replace(/^\ufeff/, "")
    .split(/\r\n|\r|\n/)
    .map((line, i) => ({ place: `line ${i + 1}`, body: line.replace(/#.*/, "").trim() }))
    .filter(({ body }) => body);
  if (!lines.length) throw new Error(`${name} holds no data. Expected are lines of ${NAMES[0]},${NAMES[1]}.`);
  const sign = ["\t", ";", ","].find((each) => lines[0].body.includes(each)),
    comma = sign !== ",";
  const rows = lines.map(({ place, body }) => ({
    place,
    cells: (sign ? body.split(sign) : body.split(/\s+/)).map((cell) => cell.trim()),
  }));
  const header = !isNumber(rows[0].cells[0], comma),
    names = header ? rows.shift().cells.map((cell) => cell.toLowerCase()) : NAMES.slice(0, 2);
  if (
    header &&
    (names.slice(0, 2).join() !== NAMES.slice(0, 2).join() || names.length > 3 || (names[2] ?? "sigma") !== "sigma")
  ) {
    throw new Error(
      `${name}: the columns are ${names.join(", ")}. A spectrum has ${NAMES[0]},${NAMES[1]} and perhaps sigma.`,
    );
  }
  let points = rows.map(({ place, cells }) => {
    if (cells.length !== names.length)
      throw new Error(`${name}, ${place}: ${cells.length} of ${names.length} columns found.`);
    const values = cells.map((cell, i) => {
      if (!isNumber(cell, comma)) throw new Error(`${name}, ${place}: ${names[i]} "${cell}" is not a number.`);
      return numberIn(cell, comma);
    });
    if (values[0] < 0) throw new Error(`${name}, ${place}: the frequency is negative.`);
    if (values.slice(1).some((x) => !(x > 1e-100 && x < 1e100)))
      throw new Error(
        `${name}, ${place}: power and sigma must be larger than 0. Leave the row out if the power is not known.`,
      );
    return { place, f: values[0], p: values[1], sigma: values[2] };
  });
  const notices = [];
  if (header)
    points.forEach(({ place, f }, i) => {
      if (i && f <= points[i - 1].f)
        throw new Error(
          `${name}, ${place}: ${f} Hz is out of order or appears twice. Sort the rows, one for each frequency.`,
        );
    });
  else points = merged(points, PIXEL_TOLERANCE * (settings.rate / settings.length), notices);
  return onBins(points, name, settings, segments, header ? GRID_TOLERANCE : PIXEL_TOLERANCE, notices);
}

// Sorted; rows within the tolerance of the first of their group are averaged.
function merged(points, tolerance, notices) {
  const groups = [];
  for (const point of [...points].sort((a, b) => a.f - b.f || a.p - b.p)) {
    const last = groups[groups.length - 1];
    if (last && point.f - last[0].f <= tolerance) last.push(point);
    else groups.push([point]);
  }
  if (groups.length < points.length) notices.push(`${points.length - groups.length} near-duplicates were averaged.`);
  const mean = (group, key) => group.reduce((sum, point) => sum + point[key], 0) / group.length;
  return groups.map((group) => ({ f: mean(group, "f"), p: mean(group, "p") }));
}

// The points on the bins: as they are if all lie on bins, else interpolated in log power.
function onBins(points, name, settings, segments, tolerance, notices) {
  const resolution = settings.rate / settings.length,
    position = points.map(({ f }) => f / resolution),
    bins = position.map((x) => Math.round(x));
  const [first, last] = [settings.first_bin, settings.last_bin];
  const aligned = position.every((x, i) => Math.abs(x - bins[i]) <= tolerance) && new Set(bins).size === bins.length;
  let found;
  if (aligned) {
    found = points.map((point, i) => ({ ...point, bin: bins[i] })).filter(({ bin }) => bin >= first && bin <= last);
    if (found.length < points.length)
      notices.push(`${points.length - found.length} rows outside the bins ${first} to ${last} were left out.`);
  } else {
    const low = position[0] - Math.max(tolerance, REACH),
      high = position[position.length - 1] + Math.max(tolerance, REACH);
    // One number is not to count as two: a bin needs a point nearby, or points no farther apart than bins.
    const known = (k) => {
      const right = Math.max(1, position.findIndex((x) => x >= k)),
        [a, b] = k > position[position.length - 1] ? [k, k] : [position[right - 1], position[right]];
      return b - a <= COARSE || Math.min(Math.abs(k - a), Math.abs(k - b)) <= 0.5;
    };
    const covered = Array.from({ length: last - first + 1 }, (_, k) => first + k).filter(
      (k) => k >= low && k <= high && known(k),
    );
    const between = (k, key) => {
      let i = position.findIndex((x) => x >= k);
      if (i === -1) return points[points.length - 1][key];
      if (i === 0) return points[0][key];
      const share = (k - position[i - 1]) / (position[i] - position[i - 1]);
      return Math.exp((1 - share) * Math.log(points[i - 1][key]) + share * Math.log(points[i][key]));
    };
    found = covered.map((bin) => ({ bin, p: between(bin, "p"), sigma: points[0].sigma && between(bin, "sigma") }));
    notices.push("The frequencies are off the grid: interpolated onto the bins in log power.");
  }
  if (found.length < 2)
    throw new Error(
      `${name} covers ${found.length} of the bins ${first} to ${last}. At least 2 are needed. Are the frequencies in Hz?`,
    );
  const total = found.reduce((sum, { p }) => sum + p, 0);
  return {
    name,
    bins: found.map(({ bin }) => bin),
    frequency: found.map(({ bin }) => bin * resolution),
    proportional_power: found.map(({ p }) => p / total),
    sigma: found[0].sigma ? found.map(({ sigma }) => sigma / total) : null,
    segments: segments ? [segments] : null,
    notices,
  };
}
