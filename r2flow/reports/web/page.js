// Takes a file, has the worker complete it, and shows measured and added points in the page of `r2flow view`.

import { write } from "./readers.js";

const element = (id) => document.getElementById(id);
const about = await (await fetch("models.json")).json(); // sensors with their models, and the colours of the view
const template = await (await fetch("view.txt")).text();
// The shortest module with a SIMD instruction, which the runtime needs.
const SIMD = Uint8Array.of(0, 97, 115, 109, 1, 0, 0, 0, 1, 5, 1, 96, 0, 1, 123, 3, 2, 1, 0, 10, 10, 1, 8, 0, 65, 0, 253, 15, 253, 98, 11);
let worker;
let result; // the last completed scan

function trouble(text) {
  element("status").textContent = "";
  element("progress").hidden = true;
  Object.assign(element("trouble"), { textContent: text, hidden: false });
}

function take(file) {
  if (!file) return;
  element("trouble").hidden = true;
  element("save").hidden = true;
  element("view").hidden = true;
  element("progress").hidden = false;
  delete document.documentElement.dataset.done;
  worker?.terminate(); // a second file replaces the first
  worker = new Worker("worker.js", { type: "module" });
  worker.onerror = (event) => trouble(`This browser cannot run it: ${event.message ?? "the worker did not start"}`);
  worker.onmessage = ({ data }) => {
    if (data.status) element("status").textContent = data.status;
    if (data.trouble) trouble(`${file.name}: ${data.trouble}`);
    if (data.done) show(file.name, data.done);
  };
  worker.postMessage({ file, sensor: element("sensor").value, models: about.models });
}

async function show(name, done) {
  result = { name, ...done };
  const known = done.measured.reduce((sum, one) => sum + one, 0);
  const added = done.measured.length - known;
  const left = done.unused.length ? `\nNot kept here: ${done.unused.join(", ")}. r2flow complete keeps every field.` : "";
  element("status").textContent = `${name}, ${done.model}: ${known.toLocaleString()} measured points in view, `
    + `${added.toLocaleString()} added in ${done.seconds.toFixed(1)} s.${left}`;
  element("progress").hidden = true;
  const page = JSON.stringify(await contents(done)).replaceAll("<", "\\u003c");
  element("view").srcdoc = template.replace("{{data}}", () => page);
  element("view").hidden = false;
  element("save").hidden = false;
  document.documentElement.dataset.done = added;
}

/** Quantiles q of values. */
function quantiles(values, ...q) {
  const sorted = Float32Array.from(values).sort();
  return q.map((share) => sorted[Math.floor(share * (sorted.length - 1))]);
}

const rounded = (values) => values.map((value) => Math.round(10 * value) / 10);

/** What the page of `r2flow view` draws: the scan as it was measured, and completed. */
async function contents({ model, scan, points, measured, errors }) {
  const { rays } = about.models.find((one) => one.name === model);
  const pixels = rays.rows * rays.columns;
  const range = scan.subarray(0, pixels);
  const reflectance = scan.length > pixels ? scan.subarray(pixels, 2 * pixels) : null;
  // Points follow the returns of the image row by row, from azimuth 0 on.
  const turn = 2 * Math.PI;
  const order = rays.azimuths.map((angle, column) => [((angle % turn) + turn) % turn, column]).sort((a, b) => a[0] - b[0]);
  const numbers = new Uint8Array(pixels); // 0 measured, then by the error: as in `r2flow.reports.view`
  const kind = (own, error) => (own ? 0 : 1 + about.view.trust.steps.filter((step) => step < error).length);
  let next = 0;
  for (let row = 0; row < rays.rows; row++) {
    for (const [, column] of order) {
      const pixel = row * rays.columns + column;
      if (range[pixel] > 0) numbers[pixel] = kind(measured[next], errors[next++]);
    }
  }
  const own = range.map((r, i) => (numbers[i] === 0 ? r : 0));
  const [near, far] = quantiles(range.filter((r) => r > 0), 0.02, 0.98);
  const [low, high] = quantiles(points.filter((_, i) => i % 4 === 2), 0.02, 0.95);
  const frame = async (ranges) => [await packed(ranges, reflectance, numbers, about.view.metres, rays.columns)];
  const panel = { rays: 0, reflectance: reflectance !== null, labels: false, errors: true };
  return {
    ...about.view,
    scans: [
      { ...panel, caption: "your scan", frames: await frame(own) },
      { ...panel, caption: "completed", frames: await frame(range) },
    ],
    rays: [rays],
    ranges: rounded([0.9 * near, 1.1 * far]),
    heights: rounded([low - 0.5, high + 0.5]),
  };
}

/** An image as `r2flow.reports.view` packs it: planes of bytes, compressed by zlib, in base64. */
async function packed(range, reflectance, numbers, metres, columns) {
  const pixels = range.length;
  const bytes = new Uint8Array(pixels * (3 + (reflectance !== null)));
  let before = 0;
  range.forEach((r, i) => {
    const code = r > 0 ? Math.min(Math.max(Math.round(r / metres), 1), 65535) : 0;
    const difference = (code - (i % columns ? before : 0)) & 65535;
    bytes[i] = difference >> 8;
    bytes[pixels + i] = difference & 255;
    before = code;
  });
  if (reflectance) bytes.set(reflectance.map((value) => Math.round(255 * value)), 2 * pixels);
  bytes.set(numbers, bytes.length - pixels);
  const stream = new Blob([bytes]).stream().pipeThrough(new CompressionStream("deflate"));
  const small = new Uint8Array(await new Response(stream).arrayBuffer());
  let text = "";
  for (let i = 0; i < small.length; i += 32768) text += String.fromCharCode(...small.subarray(i, i + 32768));
  return btoa(text);
}

function save(format) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(write(format, result.points, result.measured, result.errors));
  link.download = `${result.name.replace(/\.[^.]+$/, "")}-completed.${format}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

function start() {
  if (!WebAssembly.validate(SIMD) || typeof CompressionStream === "undefined") {
    return trouble("This page needs WebAssembly with SIMD: take a browser of 2023 or later.");
  }
  for (const { name } of about.models) element("sensor").append(new Option(name, name));
  element("file").onchange = ({ target }) => take(target.files[0]);
  element("sensor").onchange = () => take(element("file").files[0]);
  element("example").onclick = async () => {
    element("sensor").value = "";
    take(new File([await (await fetch("example.bin")).blob()], "example.bin"));
  };
  for (const button of element("save").querySelectorAll("button")) button.onclick = () => save(button.dataset.format);
  const drop = element("drop");
  const over = (on) => (event) => { event.preventDefault(); drop.classList.toggle("over", on); };
  addEventListener("dragover", over(true));
  addEventListener("dragleave", over(false));
  addEventListener("drop", (event) => {
    over(false)(event);
    element("file").files = event.dataTransfer.files;
    take(event.dataTransfer.files[0]);
  });
  document.documentElement.dataset.ready = "";
}

start();
