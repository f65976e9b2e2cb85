// Entry: ties the controls that the report has written to the model and the picture.
import { Model, niceCeiling, robustMaximum } from "./shape.js";
import { View, linear } from "./scene.js";

function start(root) {
  const data = JSON.parse(document.getElementById("model-data").textContent);
  const model = new Model(data);
  const canvas = root.querySelector("canvas");
  const view = new View(canvas, model, data.topology);
  const $ = (name) => root.querySelector(`[data-control="${name}"]`);
  const sliders = [...root.querySelectorAll("input[data-mode]")];
  const walks = [...root.querySelectorAll("button[data-walk]")];
  const points = new Float32Array(model.nPoints * 3);
  const normals = new Float32Array(model.nPoints * 3);
  const colours = new Float32Array(model.nPoints * 3);
  const ramp = data.colours.map(linear);
  const bone = linear(data.bone);
  let walk = null;

  const current = new Float32Array(model.nModes); // sliders show it in steps of 0.1; a patient's scores are kept exactly

  function paint(distance, limit) {
    for (let i = 0; i < model.nPoints; i++) {
      const x = Math.min(1, Math.max(0, 0.5 + distance[i] / limit / 2)) * (ramp.length - 1);
      const k = Math.min(ramp.length - 2, Math.floor(x));
      for (let d = 0; d < 3; d++) colours[3 * i + d] = ramp[k][d] + (x - k) * (ramp[k + 1][d] - ramp[k][d]);
    }
  }

  function refresh() {
    model.instance(current, points);
    model.normals(points, normals);
    const mapped = $("colour").value === "distance" && (walk || current.some((s) => s !== 0)); // the mean itself is plain
    $("legend").hidden = !mapped;
    if (mapped) {
      const distance = model.distances(points);
      const limit = walk ? walk.limit : niceCeiling(robustMaximum(distance));
      paint(distance, limit);
      $("low").textContent = `\u2212${limit} ${data.unit}`;
      $("high").textContent = `+${limit} ${data.unit}`;
    } else {
      for (let i = 0; i < colours.length; i++) colours[i] = bone[i % 3];
    }
    view.update(points, normals, colours);
    sliders.forEach((s) => {
      const value = current[s.dataset.mode];
      s.value = String(value);
      const text = `${value > 0 ? "+" : value < 0 ? "\u2212" : ""}${Math.abs(value).toFixed(1)} \u03c3`;
      s.parentElement.querySelector("output").textContent = text;
      s.setAttribute("aria-valuetext", `${value.toFixed(1)} standard deviations`);
    });
  }

  function stop() {
    if (!walk) return;
    cancelAnimationFrame(walk.frame);
    walk = null;
    walks.forEach((b) => { b.setAttribute("aria-pressed", "false"); b.textContent = "\u25b6"; });
  }

  function setAll(values) {
    current.forEach((_, k) => { current[k] = values ? values[k] ?? 0 : 0; });
    refresh();
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
    const limit = niceCeiling(robustMaximum(model.distances(model.instance(current, points))));
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
  $("reset").addEventListener("click", () => { stop(); $("patient").value = ""; setAll(null); });
  $("patient").addEventListener("change", (event) => {
    stop();
    const row = event.target.value === "" ? null : data.scores[Number(event.target.value)];
    setAll(row);
  });
  $("colour").addEventListener("change", refresh);
  $("pattern").addEventListener("change", (event) => view.setPattern(event.target.value));
  root.querySelectorAll("button[data-look]").forEach((b) => b.addEventListener("click", () => view.look(...b.dataset.look.split(",").map(Number))));
  $("picture").addEventListener("click", () => {
    const link = document.createElement("a");
    link.download = "shape.png";
    link.href = canvas.toDataURL("image/png");
    link.click();
  });
  $("ramp").style.background = `linear-gradient(90deg, ${data.colours.join(",")})`;
  view.resize();
  view.look(...data.look);
  view.setPattern($("pattern").value);
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
