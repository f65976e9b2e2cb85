// The picture: one or two surfaces (or curves) with vertex colours, grid lines drawn by the shader, landmarks, one camera, lights.
import {
  AmbientLight, BufferAttribute, BufferGeometry, Color, DirectionalLight, DoubleSide, HemisphereLight, InstancedMesh,
  Matrix4, Mesh, MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, Scene, Spherical, Sphere, SphereGeometry,
  Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { Line2 } from "three/addons/lines/Line2.js";
import { LineGeometry } from "three/addons/lines/LineGeometry.js";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";

const LINE_WIDTH = 3.5; // of a curve [CSS pixels]; plain lines of WebGL are one pixel wide whatever one asks for
const PATTERNS = { none: 0, lines: 1, checker: 2 };

/** Triangle corners as own vertices, so that a periodic grid needs no duplicated points; a pole lies between its neighbours. */
function cornerGrid(model, topology) {
  const [n1, n2] = model.grid.length === 2 ? model.grid : [model.nPoints, 1];
  const periodic = topology === "tube" || topology === "cone" || topology === "closed";
  const out = new Float32Array(model.faces.length * 2);
  for (let t = 0; t < model.faces.length; t += 3) {
    const rows = [0, 1, 2].map((k) => Math.floor(model.faces[t + k] / n2));
    const columns = [0, 1, 2].map((k) => model.faces[t + k] % n2);
    const pole = columns.findIndex((c) => (topology === "closed" && c === 0) || (periodic && topology !== "tube" && c === n2 - 1));
    if (pole >= 0) rows[pole] = rows[(pole + 1) % 3];
    if (periodic && Math.max(...rows) - Math.min(...rows) > n1 / 2) rows.forEach((r, k) => { if (r < n1 / 2) rows[k] = r + n1; });
    if (pole >= 0) rows[pole] = (rows[(pole + 1) % 3] + rows[(pole + 2) % 3]) / 2;
    for (let k = 0; k < 3; k++) {
      out[2 * (t + k)] = rows[k];
      out[2 * (t + k) + 1] = columns[k];
    }
  }
  return out;
}

/** One shape on the screen: what is drawn of it, and the landmarks that lie on it. */
class Pane {
  constructor(view, topology, landmarks) {
    const { model } = view;
    const isCurve = model.faces.length === 0;
    this.geometry = isCurve ? new LineGeometry() : new BufferGeometry();
    const count = isCurve ? model.nPoints + (topology === "curve-closed" ? 1 : 0) : model.faces.length;
    this.corners = isCurve ? Uint32Array.from({ length: count }, (_, i) => i % model.nPoints) : model.faces;
    if (isCurve) {
      this.line = { position: new Float32Array(count * 3), color: new Float32Array(count * 3) };
      this.object = new Line2(this.geometry, new LineMaterial({ vertexColors: true, linewidth: LINE_WIDTH }));
      this.object.frustumCulled = false;
    } else {
      for (const name of ["position", "normal", "color"]) {
        this.geometry.setAttribute(name, new BufferAttribute(new Float32Array(count * 3), 3));
      }
      this.geometry.setAttribute("gridPosition", new BufferAttribute(cornerGrid(model, topology), 2));
      this.object = new Mesh(this.geometry, surfaceMaterial(view.pattern, view.step));
    }
    const n = landmarks.reduce((sum, mark) => sum + mark.places.length, 0);
    this.marks = n ? new InstancedMesh(new SphereGeometry(1, 16, 12), new MeshBasicMaterial(), n) : null;
    let k = 0;
    for (const mark of landmarks) for (const _ of mark.places) this.marks.setColorAt(k++, new Color(mark.colour));
    if (this.marks) this.marks.frustumCulled = false;
  }

  set visible(on) {
    this.object.visible = on;
    if (this.marks) this.marks.visible = on && this.marked;
  }

  set opacity(value) {
    this.object.material.transparent = value < 1;
    this.object.material.depthWrite = value === 1;
    this.object.material.opacity = value;
    this.object.material.needsUpdate = true;
  }
}

function surfaceMaterial(pattern, step) {
  const material = new MeshStandardMaterial({ vertexColors: true, side: DoubleSide, roughness: 0.62, metalness: 0 });
  material.onBeforeCompile = (shader) => {
    shader.uniforms.pattern = pattern;
    shader.uniforms.gridStep = step;
    shader.vertexShader = `attribute vec2 gridPosition; varying vec2 vGrid;\n${shader.vertexShader}`
      .replace("#include <begin_vertex>", "#include <begin_vertex>\nvGrid = gridPosition;");
    shader.fragmentShader = `varying vec2 vGrid; uniform int pattern; uniform float gridStep;\n${shader.fragmentShader}`
      .replace("#include <color_fragment>", `#include <color_fragment>
        vec2 cell = vGrid / gridStep;
        if (pattern == 1) {
          vec2 away = abs(fract(cell - 0.5) - 0.5) / fwidth(cell);
          diffuseColor.rgb *= mix(0.28, 1.0, smoothstep(0.4, 1.3, min(away.x, away.y)));
        } else if (pattern == 2) {
          diffuseColor.rgb *= mod(floor(cell.x + 1e-4) + floor(cell.y + 1e-4), 2.0) < 0.5 ? 0.55 : 1.0;
        }
        if (!gl_FrontFacing) diffuseColor.rgb *= 0.6;`);
  };
  return material;
}

export class View {
  constructor(canvas, model, topology, landmarks) {
    this.canvas = canvas;
    this.model = model;
    this.renderer = new WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.renderer.setClearColor(0xf4f6f8);
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(28, 1, 1, 10000);
    this.camera.up.set(0, 0, 1);
    this.pattern = { value: 0 };
    this.step = { value: Math.max(1, Math.round(Math.max(...model.grid) / 16)) };
    this.layout = "one";
    this.panes = [0, 1].map(() => new Pane(this, topology, landmarks));
    for (const pane of this.panes) {
      this.scene.add(pane.object);
      if (pane.marks) this.scene.add(pane.marks);
      pane.marked = false;
    }
    this.scene.add(new AmbientLight(0xffffff, 0.35), new HemisphereLight(0xffffff, 0x8a93a0, 0.9));
    this.light = new DirectionalLight(0xffffff, 1.9);
    this.scene.add(this.light, this.light.target);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.enableZoom = false; // the wheel scrolls the page until the picture is clicked
    canvas.addEventListener("focus", () => { this.controls.enableZoom = true; });
    canvas.addEventListener("blur", () => { this.controls.enableZoom = false; });
    canvas.addEventListener("pointerdown", () => canvas.focus({ preventScroll: true }));
    canvas.addEventListener("keydown", (event) => this.#key(event));
    this.controls.addEventListener("change", () => this.draw());
    this.#fit();
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  /** Put points, normals (n, 3) and colours (n, 3, linear) of pane 0 or 1 on the screen; `key` ("3") is the patient whose marks stand out. */
  update(which, points, normals, colours, landmarks, key) {
    const pane = this.panes[which];
    for (const [name, source] of [["position", points], ["normal", normals], ["color", colours]]) {
      const attribute = pane.line ? null : pane.geometry.getAttribute(name);
      const array = pane.line ? pane.line[name] : attribute.array;
      if (!array) continue; // a curve has no normals
      pane.corners.forEach((p, corner) => {
        for (let d = 0; d < 3; d++) array[3 * corner + d] = source[3 * p + d];
      });
      if (attribute) attribute.needsUpdate = true;
    }
    if (pane.line) {
      pane.geometry.setPositions(pane.line.position);
      pane.geometry.setColors(pane.line.color);
    } else {
      pane.geometry.computeBoundingSphere();
    }
    if (pane.marks) {
      const matrix = new Matrix4(), place = new Vector3();
      let k = 0;
      for (const mark of landmarks) {
        for (const [shape, cell, weights] of mark.places) {
          place.set(0, 0, 0);
          cell.forEach((p, j) => place.add(new Vector3(points[3 * p], points[3 * p + 1], points[3 * p + 2]).multiplyScalar(weights[j])));
          const size = this.ball.radius * (key === String(shape) || key[0] === "s" ? 0.022 : 0.011);
          matrix.makeScale(size, size, size).setPosition(place);
          pane.marks.setMatrixAt(k++, matrix);
        }
      }
      pane.marks.instanceMatrix.needsUpdate = true;
    }
    this.draw();
  }

  /** "one" shape, two "beside" each other under one camera, or one "over" the other, both half transparent. */
  setLayout(layout) {
    if (layout === this.layout) return this.draw();
    this.layout = layout;
    for (const pane of this.panes) pane.opacity = layout === "over" ? 0.6 : 1; // either may lie inside the other
    const before = Math.min(1, this.camera.aspect);
    this.resize();
    const offset = this.camera.position.clone().sub(this.controls.target).multiplyScalar(before / Math.min(1, this.camera.aspect));
    this.camera.position.copy(this.controls.target).add(offset); // as large in a narrow pane as it fits
    this.controls.update();
  }

  showLandmarks(on) {
    for (const pane of this.panes) pane.marked = on;
    this.draw();
  }

  snapshot() {
    this.render();
    return this.canvas.toDataURL("image/png");
  }

  setPattern(name) {
    this.pattern.value = PATTERNS[name];
    this.draw();
  }

  #fit() {
    const box = new BufferGeometry().setAttribute("position", new BufferAttribute(this.model.mean, 3));
    box.computeBoundingSphere();
    this.ball = box.boundingSphere ?? new Sphere(new Vector3(), 1);
    this.camera.near = this.ball.radius / 50;
    this.camera.far = this.ball.radius * 50;
  }

  /** Look along a direction given by its azimuth and elevation in degrees. */
  look(azimuth, elevation) {
    const [a, e] = [azimuth, elevation].map((x) => (x * Math.PI) / 180);
    const direction = new Vector3(Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e));
    const distance = (1.22 * this.ball.radius) / Math.sin((this.camera.fov / 2) * (Math.PI / 180)) / Math.min(1, this.camera.aspect);
    this.camera.position.copy(this.ball.center).addScaledVector(direction, distance);
    this.controls.target.copy(this.ball.center);
    this.controls.update();
    this.draw();
  }

  #key(event) {
    const turn = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const zoom = { "+": 0.9, "=": 0.9, "-": 1.1 }[event.key];
    if (!turn && !zoom) return;
    event.preventDefault();
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (zoom) offset.multiplyScalar(zoom);
    if (turn) {
      const s = new Spherical().setFromCartesianCoords(offset.x, offset.z, -offset.y);
      s.theta += turn[0] * 0.12;
      s.phi = Math.min(Math.PI - 0.02, Math.max(0.02, s.phi + turn[1] * 0.12));
      const v = new Vector3().setFromSpherical(s);
      offset.set(v.x, -v.z, v.y);
    }
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.draw();
  }

  resize() {
    const { clientWidth: w, clientHeight: h } = this.canvas.parentElement;
    if (!w || !h) return;
    this.renderer.setPixelRatio(Math.min(2, globalThis.devicePixelRatio || 1));
    this.renderer.setSize(w, h, false);
    this.camera.aspect = (this.layout === "beside" ? w / 2 : w) / h;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  draw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.render();
    });
  }

  render() {
    this.light.position.copy(this.camera.position).add(new Vector3(-0.4, 0.2, 0.9).multiplyScalar(this.ball.radius * 2));
    this.light.target.position.copy(this.ball.center);
    const { clientWidth: w, clientHeight: h } = this.canvas.parentElement;
    const [first, second] = this.panes;
    const beside = this.layout === "beside";
    first.visible = true;
    second.visible = this.layout === "over";
    this.renderer.setScissorTest(false);
    this.renderer.setViewport(0, 0, beside ? w / 2 : w, h);
    if (!beside) return this.renderer.render(this.scene, this.camera);
    this.renderer.setScissorTest(true);
    this.renderer.setScissor(0, 0, w / 2, h);
    this.renderer.render(this.scene, this.camera);
    first.visible = false;
    second.visible = true;
    this.renderer.setViewport(w / 2, 0, w / 2, h);
    this.renderer.setScissor(w / 2, 0, w / 2, h);
    this.renderer.render(this.scene, this.camera);
  }
}

/** Linear RGB of a "#rrggbb" colour, as three.js wants vertex colours. */
export function linear(hex) {
  return new Color(hex).toArray();
}
