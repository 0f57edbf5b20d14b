// node check.mjs FOLDER: reads the cases from the standard input, says how far the page's closed form is from each.
import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";

const part = (name) => import(pathToFileURL(path.join(process.argv[2], name)));
const { expectedSpectrum } = await part("spectrum.mjs"), { withValues } = await part("task.mjs");
const off = (a, b) => (Number.isFinite(a) ? Math.abs(a - b) / Math.max(Math.abs(b), 1e-300) : 1e300);
const found = {};
for (const [name, { table, rows }] of Object.entries(JSON.parse(fs.readFileSync(0, "utf8")))) {
  found[name] = Math.max(...rows.map(({ values, power, mean, variance }) => {
    const seen = expectedSpectrum(withValues(table, values));
    const centre = Math.abs(mean) > 1e-9 ? off(seen.mean, mean) : 0;
    if (seen.power.length !== power.length) return 1e300;
    return Math.max(...power.map((p, k) => off(seen.power[k], p)), off(seen.variance, variance), centre);
  }));
}
process.stdout.write(JSON.stringify(found));
