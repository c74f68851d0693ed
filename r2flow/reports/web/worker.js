// Reads a scan, finds its sensor and completes it, apart from the page, which stays responsive.

import * as ort from "./onnxruntime/ort.wasm.bundle.min.mjs";
import { Refusal, read } from "./readers.js";

ort.env.wasm.wasmPaths = new URL("./onnxruntime/", import.meta.url).href;
ort.env.wasm.numThreads = self.crossOriginIsolated ? navigator.hardwareConcurrency : 1;

const FULL = [1, 100, 255, 256, 65535]; // values of full reflectance, as of `r2flow.read`
const UNLIKE = 0.35; // of the gap between beams: farther from them is another sensor
const sessions = new Map();
const say = (status) => postMessage({ status });

/** Distance of elevations from a sensor's beams, 0 on the beams and 1 at random, and the share of beams with points. */
function fit(angles, beams) {
  const sorted = [...beams].sort((a, b) => a - b);
  const gaps = sorted.slice(1).map((beam, i) => beam - sorted[i]).sort((a, b) => a - b);
  const hit = new Set();
  const apart = angles.map((angle) => {
    let nearest = 0;
    sorted.forEach((beam, i) => { if (Math.abs(beam - angle) < Math.abs(sorted[nearest] - angle)) nearest = i; });
    hit.add(nearest);
    return Math.abs(sorted[nearest] - angle);
  }).sort((a, b) => a - b);
  return { apart: apart[Math.floor(0.8 * apart.length)] / (0.4 * gaps[gaps.length >> 1]), hit: hit.size / sorted.length };
}

/** The model whose sensor has the beams of the points. */
function found(points, count, models) {
  const angles = [];
  for (let i = 0, step = Math.max(1, Math.floor(count / 4000)); i < count; i += step) {
    const [x, y, z] = points.subarray(4 * i, 4 * i + 3);
    const r = Math.hypot(x, y, z);
    if (r > 1 && r < 1e4) angles.push((Math.asin(z / r) * 180) / Math.PI);
  }
  if (angles.length < 100) throw new Refusal("Fewer than 100 of its points are 1 m to 10 km away. Are these metres?");
  const fits = models.map((model) => ({ model, ...fit(angles, model.elevations) }));
  const [best] = fits.filter((one) => one.hit > 0.7).sort((a, b) => a.apart - b.apart);
  if (!best || best.apart > UNLIKE) {
    throw new Refusal("Its points lie on the beams of none of these sensors. Choose yours above, or add it to this page: "
      + "r2flow export densify_small --to web --from SENSOR.yaml");
  }
  return best.model;
}

/** Divide intensities by their full value; those above it become 1. */
function scaled(points, count) {
  let most = 0;
  for (let i = 0; i < count; i++) most = Math.max(most, Number.isFinite(points[4 * i + 3]) ? points[4 * i + 3] : 0);
  const full = FULL.find((value) => most <= value) ?? most;
  for (let i = 0; i < count; i++) points[4 * i + 3] = Math.min(Math.max(points[4 * i + 3] / full, 0), 1);
  return full;
}

async function load(model) {
  if (!sessions.has(model.name)) {
    say(`loading the network for ${model.name} ...`);
    sessions.set(model.name, await ort.InferenceSession.create(new URL(model.file, import.meta.url).href));
  }
  return sessions.get(model.name);
}

async function complete({ file, sensor, models }) {
  say(`reading ${file.name} ...`);
  const { points, count, unused } = read(file.name, new Uint8Array(await file.arrayBuffer()));
  const model = models.find((one) => one.name === sensor) ?? found(points, count, models);
  const full = scaled(points, count);
  const session = await load(model);
  say(`completing ${count.toLocaleString()} points of ${model.name} ...`);
  const begin = performance.now();
  const { scan, completed, measured, error_68: errors } = await session.run({ points: new ort.Tensor("float32", points, [count, 4]) });
  const seconds = (performance.now() - begin) / 1000;
  if (!completed.dims[0]) throw new Refusal(`No point lies in the view of ${model.name}. Choose another sensor above.`);
  const answer = completed.data;
  for (let i = 3; i < answer.length; i += 4) answer[i] *= full;
  return { model: model.name, count, unused, seconds, scan: scan.data, points: answer, measured: measured.data, errors: errors.data };
}

onmessage = async ({ data }) => {
  try {
    postMessage({ done: await complete(data) });
  } catch (error) {
    const text = error instanceof Refusal ? error.message : `It cannot be completed: ${error.message ?? error}`;
    postMessage({ trouble: text });
  }
};
