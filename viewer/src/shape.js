// The statistical shape model in the browser: decoding of the quantized arrays, instances, normals, signed distance.

function bytes(base64) {
  const text = atob(base64);
  const out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
  return out.buffer;
}

/** Points that were rounded to multiples of `step` from `offset`. */
function decoded({ offset, step, data }) {
  return Float32Array.from(new Uint16Array(bytes(data)), (q, i) => offset[i % 3] + q * step);
}

export class Model {
  constructor(data) {
    const n = data.n_points * 3;
    this.mean = decoded(data.mean);
    const modes = new Int16Array(bytes(data.modes.data));
    // displacement [mm] for one standard deviation of each mode
    this.modes = data.modes.step.map((step, k) => Float32Array.from(modes.subarray(k * n, (k + 1) * n), (q) => q * step));
    this.shapes = (data.shapes ?? []).map(decoded); // given point by point, not by modes
    this.maps = (data.maps ?? []).map(({ step, data: text }) => Float32Array.from(new Int16Array(bytes(text)), (q) => q * step));
    const Index = data.n_points > 65535 ? Uint32Array : Uint16Array;
    this.faces = new Index(bytes(data.faces));
    this.grid = data.grid;
    this.nPoints = data.n_points;
    this.nModes = this.modes.length;
    this.meanNormals = this.normals(this.mean);
  }

  /** Points at `sigmas` standard deviations of the modes, written into `out`. */
  instance(sigmas, out) {
    out.set(this.mean);
    this.modes.forEach((mode, k) => {
      const s = sigmas[k];
      if (s) for (let i = 0; i < out.length; i++) out[i] += s * mode[i];
    });
    return out;
  }

  /** Area-weighted unit normals at the points. */
  normals(points, out = new Float32Array(points.length)) {
    out.fill(0);
    const f = this.faces;
    for (let t = 0; t < f.length; t += 3) {
      const a = 3 * f[t], b = 3 * f[t + 1], c = 3 * f[t + 2];
      const ux = points[b] - points[a], uy = points[b + 1] - points[a + 1], uz = points[b + 2] - points[a + 2];
      const vx = points[c] - points[a], vy = points[c + 1] - points[a + 1], vz = points[c + 2] - points[a + 2];
      const n = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
      for (const i of [a, b, c]) for (let d = 0; d < 3; d++) out[i + d] += n[d];
    }
    for (let i = 0; i < out.length; i += 3) {
      const length = Math.hypot(out[i], out[i + 1], out[i + 2]) || 1;
      for (let d = 0; d < 3; d++) out[i + d] /= length;
    }
    return out;
  }

  /** Signed distance [mm] of `points` from `from` along the normals of the mean; plain distance for curves, which have no normal here. */
  distances(points, from = this.mean) {
    const out = new Float32Array(this.nPoints);
    const flat = this.faces.length === 0;
    for (let i = 0; i < this.nPoints; i++) {
      const d = [0, 1, 2].map((k) => points[3 * i + k] - from[3 * i + k]);
      out[i] = flat ? Math.hypot(...d) : d.reduce((sum, x, k) => sum + x * this.meanNormals[3 * i + k], 0);
    }
    return out;
  }
}

/** Smallest of 1, 2, 5 x 10^k that is at least `x`. */
export function niceCeiling(x) {
  if (!(x > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(x));
  return power * [1, 2, 5, 10].find((m) => m * power >= x * 0.999);
}

/** Value below which 99 % of |values| lie. */
export function robustMaximum(values) {
  const sorted = Float32Array.from(values, Math.abs).sort();
  return sorted[Math.floor(0.99 * (sorted.length - 1))];
}
