// The page: its state, what a change of a control does, what is drawn.
import { get, withValues } from "./task.mjs";
import { expectedSpectrum } from "./spectrum.mjs";
import { frequencies, lowpass, samplesIn, segmentsIn } from "./settings.mjs";
import { directions, movedAlong, statisticsOf } from "./statistics.mjs";
import { simulate } from "./simulate.mjs";
import { readTarget } from "./target.mjs";
import {
  allowed,
  asTask,
  hasDrive,
  noiseOf,
  outOfBounds,
  refusal,
  resonancesOf,
  taskIn,
  usuallyFree,
  withActivation,
  withDrive,
  withNoise,
  withResonances,
} from "./model.mjs";
import { $, digits, showSpectrum } from "./view.mjs";
import { makeRows, showRows } from "./controls.mjs";
import { History, fromFragment, toFragment } from "./state.mjs";

const facts = JSON.parse($("facts").textContent),
  content = JSON.parse($("content").textContent);
let state,
  history,
  said = "",
  anchor = null,
  found = [],
  waiting = 0;

// --- What is seen

function seenNow() {
  const refused = refusal(state.table, facts);
  if (refused) throw new Error(refused);
  return expectedSpectrum(state.table);
}

function redraw(moving) {
  const { table } = state;
  showRows($("parameters"), table, facts.parameters, moving);
  let seen;
  try {
    seen = seenNow();
  } catch (error) {
    say(error.message, true);
    $("figure").classList.add("stale");
    window.explorer.spectrum = null;
    return;
  }
  say(said);
  $("figure").classList.remove("stale");
  const chi2 = showSpectrum(state, seen);
  window.explorer.spectrum = { frequency: frequencies(table.settings), power: seen.power, chi2 };
}

function say(text, bad = false) {
  if ($("message").textContent !== text) $("message").textContent = text;
  $("message").classList.toggle("bad", bad);
}

// --- What the data do not determine

function lookAround() {
  clearTimeout(waiting);
  anchor = null;
  $("along").value = 0;
  $("along").disabled = true;
  waiting = setTimeout(findDirections, 250);
}

function findDirections() {
  clearTimeout(waiting);
  const { table, target } = state,
    s = table.settings;
  const bins = target ? target.bins : frequencies(s).map((_, k) => s.first_bin + k),
    at = bins.map((k) => k - s.first_bin);
  const chosen = Math.min($("direction").selectedIndex === -1 ? 0 : $("direction").selectedIndex, 99);
  try {
    const seen = seenNow(),
      names = usuallyFree(table, facts, get),
      share = at.map((k) => seen.line[k] / seen.power[k]);
    const data = target ?? { bins, segments: [Math.max(segmentsIn(s, samplesIn(s)), 1)] };
    const { sd, correlation } = statisticsOf(data, s, share);
    found = directions(table, names, facts.parameters, (moved) => expectedSpectrum(moved), sd, correlation, at);
    $("direction-hint").textContent = target
      ? "A slider along several parameters at once, here and for your spectrum. Directions that the data see least come first."
      : "A slider along several parameters at once, here and for a recording of 10 s. Directions that such data see least come first.";
  } catch (error) {
    found = [];
    $("direction-hint").textContent = error.message;
  }
  $("direction").replaceChildren(
    ...found.map(
      ({ strength }, i) =>
        new Option(
          `${i + 1}: ${strength < 0.005 ? "these data do not see it" : `a step of 1 is ${digits(strength, 2)} sd of the data`}`,
          i,
        ),
    ),
  );
  $("direction").selectedIndex = Math.min(chosen, found.length - 1);
  anchor = structuredClone(table);
  $("along").disabled = !found.length;
  showShares();
}

function showShares() {
  const { shares } = found[$("direction").selectedIndex] ?? { shares: {} };
  const largest = Object.entries(shares)
    .sort((a, b) => Math.abs(b[1]) - Math.abs(a[1]))
    .filter(([, x]) => Math.abs(x) > 0.1)
    .slice(0, 6);
  $("direction-shares").textContent = largest
    .map(([name, x]) => `${name} ${x > 0 ? "up" : "down"} ${Math.abs(x).toFixed(2)}`)
    .join(", ");
}

// --- What changes

function set(changes, { moving = null, done = true, around = true } = {}) {
  state = { ...state, ...changes };
  if (done) {
    history.keep(state);
    window.history.replaceState(null, "", `#${toFragment(state)}`);
  }
  if (around) lookAround();
  redraw(moving);
  $("undo").disabled = history.past.length < 2;
  $("redo").disabled = !history.future.length;
}

// Another structure: rows are made anew, and channels that the task refuses are switched off.
function rebuild(table, changes = {}) {
  const { table: good, off } = allowed(table, facts);
  said = off.length
    ? `Switched off, since this noise is too rough for this task there: ${off.map((name) => `noise_${name}`).join(", ")}.`
    : "";
  set({ ...changes, table: good });
  showAll();
}

function showAll() {
  const { table, target } = state,
    s = table.settings;
  makeRows($("parameters"), table, facts.parameters, changeParameter);
  $("task").value = table.task;
  $("observe-row").hidden = table.task !== "prescribed-force";
  $("observe").value = table.observe ?? "displacement";
  $("argument").value = table.muscle.argument ?? "literal";
  $("noise").value = noiseOf(table, facts);
  $("with-activation").checked = Boolean(table.activation);
  $("with-drive").checked = hasDrive(table);
  $("with-drive").disabled = noiseOf(table, facts) === "";
  $("with-tremor").checked = resonancesOf(table).length > 0;
  $("with-second").checked = resonancesOf(table).length > 1;
  $("with-second").disabled = resonancesOf(table).length === 0;
  const shape = ({ sampling, filter_order, filter_cutoff, filter_direction, ...rest }) =>
    JSON.stringify(Object.entries(rest).sort());
  $("settings").value = Object.keys(facts.settings).find((name) => shape(facts.settings[name]) === shape(s)) ?? "own";
  $("sampling").value = s.sampling;
  $("settings").disabled = $("sampling").disabled = Boolean(target);
  $("trace").checked = state.trace;
  $("seed").value = state.seed;
  $("linear").value = state.linear ? "1" : "";
  $("target-box").hidden = !target;
  if (target) {
    $("target-name").textContent = target.name;
    $("segments").value = target.segments?.length === 1 ? target.segments[0] : "";
    $("segments").placeholder = target.segments ? target.segments.join(" + ") : "";
    $("target-hint").textContent = [
      ...(target.notices ?? []),
      "How its spectrum was estimated is fixed while it is here.",
    ].join(" ");
  }
  redraw();
}

function changeParameter(name, value, done) {
  const wrong = outOfBounds(name, value, facts);
  if (wrong) {
    redraw();
    say(wrong, true);
    return;
  }
  said = "";
  set({ table: withValues(state.table, { [name]: value }) }, { moving: done ? null : name, done });
}

function load(next) {
  state = { target: null, seed: 1, linear: false, trace: false, ...next };
  said = "";
}

function begin() {
  let next = content.state ?? { table: facts.tasks.isometric };
  let wrong = "";
  try {
    next = fromFragment(location.hash.slice(1)) ?? next;
  } catch (error) {
    wrong = error.message;
  }
  load(structuredClone(next));
  said = wrong;
  history = new History(state);
  // For the console of the browser, and for tests.
  window.explorer = {
    get state() {
      return state;
    },
    spectrum: null,
    findDirections,
    expectedSpectrum,
    simulate,
    lowpass,
  };
  lookAround();
  showAll();
  $("undo").disabled = $("redo").disabled = true;
}

// --- Files

async function open(file) {
  const text = await file.text();
  try {
    if (file.name.endsWith(".json")) {
      const task_table = taskIn(JSON.parse(text).task_table, file.name, facts);
      rebuild(task_table, { target: null });
      say(`Opened ${file.name}.`);
      return;
    }
    const target = readTarget(text, file.name, state.table.settings, state.target?.segments?.[0] ?? null);
    said = target.sigma || target.segments ? "" : "Say how many Welch segments were averaged, and chi² is known.";
    set({ target });
    showAll();
  } catch (error) {
    say(error instanceof SyntaxError ? `${file.name} is not valid JSON.` : error.message, true);
  }
}

function save() {
  const task_table = { activation: "none", initial: "none", ...state.table };
  const text = JSON.stringify({ format: 2, description: "Set in the explorer", task_table }, null, 2);
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  link.download = "explored.json";
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  say('Saved as explored.json. In Python: jm.load_preset("explored.json")');
}

async function copyLink() {
  window.history.replaceState(null, "", `#${toFragment(state)}`);
  try {
    await navigator.clipboard.writeText(location.href);
    say("The link is copied. It holds the parameters and your spectrum.");
  } catch {
    say("The link is in the address bar: copy it there. It holds the parameters and your spectrum.");
  }
}

// --- Controls

const options = (select, pairs) => select.replaceChildren(...pairs.map(([value, text]) => new Option(text, value)));
const TASK_WORDS = {
  isometric: "isometric: held insertion, force",
  "prescribed-length": "prescribed length: force at a motor (held here)",
  "prescribed-motion": "prescribed motion: internal force (the paper's task 1)",
  "prescribed-force": "prescribed force: motion (the paper's task 2)",
};
const SETTINGS_WORDS = {
  standard: "standard: 0.39 Hz bins to 11.7 Hz",
  slow: "slow: 0.1 Hz bins",
  multitaper: "multitaper: three Slepian tapers",
  pwelch: "pwelch: MATLAB's defaults",
};

function wire() {
  options(
    $("task"),
    Object.keys(facts.tasks).map((name) => [name, TASK_WORDS[name] ?? name]),
  );
  options(
    $("observe"),
    facts.observed.map((name) => [name, name]),
  );
  options($("noise"), [...Object.keys(facts.noises).map((name) => [name, name]), ["", "only a resonance"]]);
  $("noise").lastElementChild.disabled = true;
  options($("settings"), [
    ...Object.keys(facts.settings).map((name) => [name, SETTINGS_WORDS[name] ?? name]),
    ["own", "settings of its own"],
  ]);
  $("settings").lastElementChild.disabled = true;
  const on = (id, event, action) => $(id).addEventListener(event, action);
  on("task", "change", () => rebuild(asTask(state.table, $("task").value, facts)));
  on("observe", "change", () => rebuild({ ...state.table, observe: $("observe").value }));
  on("argument", "change", () =>
    rebuild({ ...state.table, muscle: { ...state.table.muscle, argument: $("argument").value } }),
  );
  on("noise", "change", () => rebuild(withNoise(state.table, $("noise").value, facts)));
  on("with-activation", "change", () => rebuild(withActivation(state.table, $("with-activation").checked, facts)));
  on("with-drive", "change", () => rebuild(withDrive(state.table, $("with-drive").checked, facts)));
  on("with-tremor", "change", () => rebuild(withResonances(state.table, $("with-tremor").checked ? 1 : 0, facts)));
  on("with-second", "change", () => rebuild(withResonances(state.table, $("with-second").checked ? 2 : 1, facts)));
  on("settings", "change", () =>
    rebuild({
      ...state.table,
      settings: { ...facts.settings[$("settings").value], sampling: state.table.settings.sampling },
    }),
  );
  on("sampling", "change", () =>
    rebuild({ ...state.table, settings: { ...state.table.settings, sampling: $("sampling").value } }),
  );
  for (const id of ["power", "log-frequency"]) on(id, "change", () => redraw());
  on("trace", "change", () => set({ trace: $("trace").checked }, { around: false }));
  on("linear", "change", () => set({ linear: $("linear").value !== "" }, { around: false }));
  on("seed", "change", () => set({ seed: Math.max(0, Math.round(Number($("seed").value) || 0)) }, { around: false }));
  on("segments", "change", () => {
    const count = Math.round(Number($("segments").value));
    said = "";
    set({ target: { ...state.target, segments: count >= 1 ? [count] : null } });
  });
  on("remove", "click", () => {
    set({ target: null });
    showAll();
    $("open").focus();
  });
  on("direction", "change", () => {
    $("along").value = 0;
    anchor = structuredClone(state.table);
    showShares();
  });
  const along = (done) => {
    if (!anchor || !found.length) return;
    const { shares } = found[$("direction").selectedIndex];
    set(
      { table: withValues(anchor, movedAlong(anchor, shares, facts.parameters, Number($("along").value))) },
      { done, around: false },
    );
  };
  on("along", "input", () => along(false));
  on("along", "change", () => along(true));
  on("undo", "click", () => step(history.undo()));
  on("redo", "click", () => step(history.redo()));
  on("reset", "click", () => {
    said = "";
    const first = history.first;
    set(first);
    showAll();
  });
  on("link", "click", copyLink);
  on("save", "click", save);
  on("open", "click", () => $("file").click());
  on("file", "change", () => {
    if ($("file").files.length) open($("file").files[0]);
    $("file").value = "";
  });
  for (const event of ["dragenter", "dragover"])
    document.addEventListener(event, (e) => {
      e.preventDefault();
      document.body.classList.add("dropping");
    });
  document.addEventListener("dragleave", (e) => {
    if (!e.relatedTarget) document.body.classList.remove("dropping");
  });
  document.addEventListener("drop", (e) => {
    e.preventDefault();
    document.body.classList.remove("dropping");
    if (e.dataTransfer.files.length) open(e.dataTransfer.files[0]);
  });
  window.addEventListener("hashchange", begin);
  let width = 0;
  new ResizeObserver(() => {
    if ($("figure-box").clientWidth !== width) {
      width = $("figure-box").clientWidth;
      if (state) redraw();
    }
  }).observe($("figure-box"));
}

function step(next) {
  load(next);
  lookAround();
  showAll();
  window.history.replaceState(null, "", `#${toFragment(state)}`);
  $("undo").disabled = history.past.length < 2;
  $("redo").disabled = !history.future.length;
}

wire();
begin();
