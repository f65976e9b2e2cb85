// Entry: ties the controls that the report has written to the model and the picture. A page may leave controls out.
import { Model, niceCeiling, robustMaximum } from "./shape.js";
import { View, linear } from "./scene.js";

const signed = (x, digits) => `${x > 0 ? "+" : x < 0 ? "\u2212" : ""}${Math.abs(x).toFixed(digits)}`;

function start(root) {
  const data = JSON.parse(document.getElementById("model-data").textContent);
  const model = new Model(data);
  const canvas = root.querySelector("canvas");
  const view = new View(canvas, model, data.topology, data.landmarks ?? []);
  const nothing = document.createElement("input"); // stands for a control that this page does not have
  const $ = (name) => root.querySelector(`[data-control="${name}"]`) ?? nothing;
  const sliders = [...root.querySelectorAll("input[data-mode]")];
  const walks = [...root.querySelectorAll("button[data-walk]")];
  const groups = data.groups ?? [];
  const flat = model.faces.length === 0; // a curve: distances have no sign, and thin lines need dark colours
  const stops = flat ? ["#17608f", "#8a5a86", "#c4421d"] : data.colours;
  const ramp = stops.map(linear);
  const bone = linear(flat ? stops[0] : data.bone);
  const panes = [0, 1].map(() => ["points", "normals", "colours"].map(() => new Float32Array(model.nPoints * 3)));
  const current = new Float32Array(model.nModes); // sliders show it in steps of 0.1; a patient's scores are kept exactly
  const bar = root.querySelector("[data-control=ramp]");
  let walk = null;

  function meanScores(members) {
    return Array.from(current, (_, k) => members.reduce((sum, i) => sum + (data.scores[i][k] ?? 0), 0) / members.length);
  }

  const isPatient = (key) => /^\d/.test(key);

  /** Scores of a patient ("3") or of the mean of a group ("g0"); null for what is not made from modes. */
  function scoresOf(key) {
    const found = isPatient(key) ? data.scores[Number(key)] : key[0] === "g" ? meanScores(groups[Number(key.slice(1))].members) : null;
    return found && Float32Array.from(found); // as exact as the sliders, so that a shape does not differ from itself
  }

  function pointsOf(key, out) {
    if (key[0] === "s") out.set(model.shapes[Number(key.slice(1))]);
    else if (key === "mean") out.set(model.mean);
    else if (key === "") model.instance(current, out);
    else model.instance(scoresOf(key), out);
    return out;
  }

  function groupColour(key) {
    const column = $("column").value;
    const mine = groups.filter((g) => g.column === column);
    const found = key[0] === "g" ? groups[Number(key.slice(1))] : isPatient(key) ? mine.find((g) => g.members.includes(Number(key))) : null;
    return found ? linear(found.colour) : bone;
  }

  function paint(colours, distance, limit, unsigned) {
    for (let i = 0; i < model.nPoints; i++) {
      const share = unsigned ? distance[i] / limit : 0.5 + distance[i] / limit / 2;
      const from = unsigned && !flat ? (ramp.length - 1) / 2 : 0; // without a sign: the half of the scale that lies outside
      const x = from + Math.min(1, Math.max(0, share)) * (ramp.length - 1 - from);
      const k = Math.min(ramp.length - 2, Math.floor(x));
      for (let d = 0; d < 3; d++) colours[3 * i + d] = ramp[k][d] + (x - k) * (ramp[k + 1][d] - ramp[k][d]);
    }
  }

  const plain = (colours, rgb) => { for (let i = 0; i < colours.length; i++) colours[i] = rgb[i % 3]; };
  const words = (name) => { const option = $(name).selectedOptions?.[0]; return option ? option.textContent : ""; };

  function refresh() {
    const first = $("patient").value, second = $("other").value;
    const layout = second ? $("layout").value || "beside" : "one";
    const how = $("colour").value;
    const shown = [pointsOf(first[0] === "s" || first === "mean" ? first : "", panes[0][0])];
    if (second) shown.push(pointsOf(second, panes[1][0]));
    const maps = shown.map((points, k) => {
      if (how.startsWith("map")) return k === 0 ? model.maps[Number(how.slice(3))] : null;
      if (how === "other") return second && k === 0 ? model.distances(points, shown[1]) : null;
      return how === "distance" ? model.distances(points) : null;
    }).map((map) => (map && (walk || map.some((x) => x !== 0)) ? map : null)); // the mean itself is plain
    const unsigned = flat || (how.startsWith("map") && data.maps[Number(how.slice(3))].signed === false);
    const limit = walk ? walk.limit : niceCeiling(Math.max(0, ...maps.filter(Boolean).map(robustMaximum)));
    shown.forEach((points, k) => {
      const [, normals, colours] = panes[k];
      model.normals(points, normals);
      if (maps[k]) paint(colours, maps[k], limit, unsigned);
      else plain(colours, how === "group" ? groupColour(k ? second : first) : bone);
      view.update(k, points, normals, colours, data.landmarks ?? [], [first, second][k]);
    });
    view.setLayout(layout);
    const mapped = maps.some(Boolean);
    $("legend").hidden = !mapped;
    if (mapped) {
      const about = how.startsWith("map") ? words("colour") : how === "other" ? `Distance from ${words("other")}` : "Distance from the mean";
      const signs = unsigned ? "" : how.startsWith("map") ? ", outwards positive" : ", along the outward normal of the mean";
      $("caption").textContent = about + signs;
      $("low").textContent = unsigned ? "0" : `\u2212${limit} ${data.unit}`;
      const shades = unsigned && !flat ? stops.slice((stops.length - 1) / 2) : stops;
      if (bar) bar.style.background = `linear-gradient(90deg, ${shades.join(",")})`;
      $("high").textContent = `${unsigned && !flat ? "" : "+"}${limit} ${data.unit}`;
    }
    $("name-a").hidden = $("name-b").hidden = layout !== "beside";
    $("name-a").textContent = words("patient");
    $("name-b").textContent = words("other");
    $("layout-row").hidden = !second;
    root.querySelectorAll("[data-column]").forEach((item) => { item.hidden = item.dataset.column !== $("column").value; });
    $("landmark-key").hidden = !$("landmarks").checked;
    sliders.forEach((s) => {
      const value = current[s.dataset.mode];
      s.value = String(value);
      s.parentElement.querySelector("output").textContent = `${signed(value, 1)} \u03c3`;
      s.setAttribute("aria-valuetext", `${value.toFixed(1)} standard deviations`);
    });
  }

  function stop() {
    if (!walk) return;
    cancelAnimationFrame(walk.frame);
    walk = null;
    walks.forEach((b) => { b.setAttribute("aria-pressed", "false"); b.textContent = "\u25b6"; });
  }

  sliders.forEach((s) => s.addEventListener("input", () => {
    stop();
    $("patient").value = "";
    current[s.dataset.mode] = Number(s.value);
    refresh();
  }));
  walks.forEach((button) => button.addEventListener("click", () => {
    const again = walk && walk.button === button;
    stop();
    if (again) return refresh();
    const mode = Number(button.dataset.walk);
    $("patient").value = "";
    current.fill(0);
    current[mode] = 3;
    const limit = niceCeiling(robustMaximum(model.distances(model.instance(current, panes[0][0]))));
    const begin = performance.now();
    walk = { button, limit, frame: 0 };
    button.setAttribute("aria-pressed", "true");
    button.textContent = "\u25a0";
    const tick = (now) => {
      if (!walk) return;
      current[mode] = 3 * Math.sin(((now - begin) / 4000) * 2 * Math.PI);
      refresh();
      walk.frame = requestAnimationFrame(tick);
    };
    walk.frame = requestAnimationFrame(tick);
  }));
  $("reset").addEventListener("click", () => {
    stop();
    $("patient").value = "";
    current.fill(0);
    refresh();
  });
  $("patient").addEventListener("change", () => {
    stop();
    const values = scoresOf($("patient").value);
    current.forEach((_, k) => { current[k] = values?.[k] ?? 0; });
    refresh();
  });
  for (const name of ["colour", "other", "layout", "column"]) $(name).addEventListener("change", refresh);
  $("pattern").addEventListener("change", (event) => view.setPattern(event.target.value));
  $("landmarks").addEventListener("change", () => {
    view.showLandmarks($("landmarks").checked);
    refresh();
  });
  root.querySelectorAll("button[data-look]").forEach((b) => b.addEventListener("click", () => view.look(...b.dataset.look.split(",").map(Number))));
  $("picture").addEventListener("click", () => {
    const link = document.createElement("a");
    link.download = `${($("patient").value && words("patient").replace(/[^\w.-]+/g, "_")) || "shape"}.png`;
    link.href = view.snapshot();
    link.click();
  });
  root.querySelectorAll("[data-swatch]").forEach((s) => { s.style.background = s.dataset.swatch; });
  view.resize();
  view.look(...data.look);
  view.setPattern($("pattern").value || "none");
  refresh();
  root.dataset.state = "ready";
}

const root = document.getElementById("viewer");
if (root) {
  try {
    start(root);
  } catch (error) {
    root.dataset.state = "failed";
    root.querySelector("[data-control=problem]").textContent =
      `The 3-D view could not start (${error.message}). The pictures of the modes below show the same model.`;
  }
}
