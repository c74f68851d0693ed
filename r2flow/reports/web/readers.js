// Scans of .pcd, .ply, .bin and .csv files as float32 rows of x, y, z in metres and intensity.

const MOST = 4e6; // points of a file
const NAMES = {
  x: ["x"], y: ["y"], z: ["z"],
  intensity: ["intensity", "reflectance", "reflectivity", "remission", "i", "scalar_intensity"],
};
const PCD = { F4: "Float32", F8: "Float64", U1: "Uint8", U2: "Uint16", U4: "Uint32", I1: "Int8", I2: "Int16", I4: "Int32" };
const PLY = {
  char: "Int8", int8: "Int8", uchar: "Uint8", uint8: "Uint8", short: "Int16", int16: "Int16", ushort: "Uint16",
  uint16: "Uint16", int: "Int32", int32: "Int32", uint: "Uint32", uint32: "Uint32", float: "Float32",
  float32: "Float32", double: "Float64", float64: "Float64",
};

export class Refusal extends Error {}

/** The points of a file, { points, count, unused: names of fields that are not kept }. */
export function read(name, bytes) {
  const ending = name.toLowerCase().split(".").pop();
  if (!bytes.length) throw new Refusal("The file is empty.");
  const reader = { pcd: readPcd, ply: readPly, bin: readBin, csv: readCsv }[ending];
  if (!reader) throw new Refusal(`A .${ending} is not read here. Convert it to .pcd, .ply, .bin or .csv.`);
  return reader(bytes);
}

/** Points from fields { name, at(row) }; the first name of each role counts. */
function gathered(fields, count) {
  if (!(count > 0)) throw new Refusal("The file has no points.");
  if (count > MOST) throw new Refusal(`${count.toLocaleString()} points are more than one scan; at most ${MOST.toLocaleString()}.`);
  const plain = fields.map((field) => field.name.toLowerCase());
  const roles = Object.values(NAMES).map((names) => {
    const name = names.find((one) => plain.includes(one));
    return name === undefined ? null : fields[plain.indexOf(name)];
  });
  const missing = ["x", "y", "z"].filter((_, i) => !roles[i]);
  if (missing.length) {
    throw new Refusal(`The file has no field ${missing.join(", ")}. It has: ${fields.map((field) => field.name).join(", ").slice(0, 120)}.`);
  }
  const points = new Float32Array(4 * count);
  roles.forEach((field, role) => {
    if (field) for (let row = 0; row < count; row++) points[4 * row + role] = field.at(row);
  });
  const unused = fields.filter((field) => !roles.includes(field)).map((field) => field.name);
  return { points, count, unused };
}

/** Fields of packed rows: [{ name, type, offset }], in little-endian bytes unless said. */
function packed(bytes, fields, step, count, little = true) {
  if (count * step > bytes.length) throw new Refusal("The file ends before its last point. Is it complete?");
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  return gathered(fields.map(({ name, type, offset }) => {
    const get = view[`get${type}`].bind(view);
    return { name, at: (row) => get(row * step + offset, little) };
  }), count);
}

/** Fields of lines of text, by the places of their values. */
function written(lines, names, separator) {
  const rows = lines.filter((line) => line.trim()).map((line) => line.trim().split(separator));
  const short = rows.findIndex((row) => row.length < names.length);
  if (short >= 0) throw new Refusal(`Line ${short + 1} of the points has ${rows[short].length} values instead of ${names.length}.`);
  return gathered(names.map((name, place) => ({ name, at: (row) => Number(rows[row][place]) })), rows.length);
}

/** Lines of a header up to one that matches, and where the data begin. */
function header(bytes, last) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, 65536));
  const end = text.search(last);
  const line = end < 0 ? -1 : text.indexOf("\n", end);
  if (line < 0) throw new Refusal("The file has no header of its format.");
  return { lines: text.slice(0, line).split(/\r?\n/).map((one) => one.trim()), data: bytes.subarray(line + 1) };
}

const textOf = (bytes) => new TextDecoder("latin1").decode(bytes).split(/\r?\n/);

function readPcd(bytes) {
  const { lines, data } = header(bytes, /^DATA/m);
  const said = Object.fromEntries(lines.filter((line) => line && line[0] !== "#").map((line) => {
    const [key, ...values] = line.split(/\s+/);
    return [key, values];
  }));
  const { FIELDS: names = [], SIZE = [], TYPE = [], COUNT = [] } = said;
  const kind = said.DATA?.[0];
  const count = Number(said.POINTS?.[0] ?? said.WIDTH?.[0] * said.HEIGHT?.[0]);
  const counts = names.map((_, i) => Number(COUNT[i] ?? 1));
  if (kind === "ascii") {
    const each = names.flatMap((name, i) => Array(counts[i]).fill(name));
    return written(textOf(data).slice(0, count), each, /\s+/);
  }
  let offset = 0;
  const fields = names.map((name, i) => {
    const type = PCD[`${TYPE[i]}${SIZE[i]}`];
    const field = { name, type, offset, size: Number(SIZE[i]) * counts[i] };
    offset += field.size;
    return field;
  });
  const known = fields.filter((field) => field.type && field.size);
  if (kind === "binary") return packed(data, known, offset, count);
  if (kind !== "binary_compressed") throw new Refusal(`PCD DATA ${kind} is not read.`);
  const sizes = new DataView(data.buffer, data.byteOffset);
  if (data.length < 8 || count > MOST || sizes.getUint32(4, true) !== offset * count) throw new Refusal("Its compressed data have another size than its header says.");
  const columns = decompressed(data.subarray(8, 8 + sizes.getUint32(0, true)), offset * count);
  const view = new DataView(columns.buffer);
  return gathered(known.map(({ name, type, offset: before, size }) => {
    const get = view[`get${type}`].bind(view);
    return { name, at: (row) => get(before * count + row * size, true) }; // column after column
  }), count);
}

/** LZF (Marc Lehmann's liblzf), as in compressed PCD files. */
function decompressed(from, size) {
  const into = new Uint8Array(size);
  let [i, o] = [0, 0];
  while (i < from.length && o < size) {
    const control = from[i++];
    if (control < 32) {
      for (let left = control + 1; left > 0; left--) into[o++] = from[i++];
      continue;
    }
    let length = control >> 5;
    if (length === 7) length += from[i++];
    let back = o - ((control & 31) << 8) - from[i++] - 1;
    if (back < 0) throw new Refusal("Its compressed data are damaged.");
    for (let left = length + 2; left > 0; left--) into[o++] = into[back++];
  }
  return into;
}

function readPly(bytes) {
  const { lines, data } = header(bytes, /^end_header/m);
  const kind = lines.find((line) => line.startsWith("format"))?.split(/\s+/)[1];
  const first = lines.findIndex((line) => line.startsWith("element"));
  const [, element, number] = lines[first]?.split(/\s+/) ?? [];
  if (element !== "vertex") throw new Refusal("Its first element is not vertex.");
  const fields = [];
  let step = 0;
  for (const line of lines.slice(first + 1)) {
    const [word, type, name] = line.split(/\s+/);
    if (word === "element" || word === "end_header") break;
    if (word !== "property") continue;
    if (!PLY[type]) throw new Refusal(`A vertex property of type ${type} is not read.`);
    fields.push({ name, type: PLY[type], offset: step });
    step += Number(PLY[type].match(/\d+/)[0]) / 8;
  }
  const count = Number(number);
  if (kind === "ascii") return written(textOf(data).slice(0, count), fields.map((field) => field.name), /\s+/);
  return packed(data, fields, step, count, kind !== "binary_big_endian");
}

function readBin(bytes) {
  const names = ["x", "y", "z", "intensity"];
  if (bytes.length % 16) throw new Refusal("A .bin has rows of four float32: x, y, z, intensity. This one has other rows: convert it to .pcd.");
  return packed(bytes, names.map((name, i) => ({ name, type: "Float32", offset: 4 * i })), 16, bytes.length / 16);
}

function readCsv(bytes) {
  const [first, ...lines] = textOf(bytes);
  const separator = first.includes(";") ? ";" : ",";
  return written(lines, first.split(separator).map((name) => name.trim().replaceAll('"', "")), separator);
}

/** A .pcd or .ply of completed points, rows of x, y, z, intensity, with their predicted errors and `measured`. */
export function write(format, points, measured, errors) {
  const count = measured.length;
  const view = new DataView(new ArrayBuffer(21 * count));
  for (let i = 0; i < count; i++) {
    for (let j = 0; j < 4; j++) view.setFloat32(21 * i + 4 * j, points[4 * i + j], true);
    view.setFloat32(21 * i + 16, errors[i], true);
    view.setUint8(21 * i + 20, measured[i]);
  }
  const head = format === "ply"
    ? `ply\nformat binary_little_endian 1.0\nelement vertex ${count}\nproperty float x\nproperty float y\n`
      + "property float z\nproperty float intensity\nproperty float error_68\nproperty uchar measured\nend_header\n"
    : "VERSION 0.7\nFIELDS x y z intensity error_68 measured\nSIZE 4 4 4 4 4 1\nTYPE F F F F F U\nCOUNT 1 1 1 1 1 1\n"
      + `WIDTH ${count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS ${count}\nDATA binary\n`;
  return new Blob([head, view], { type: "application/octet-stream" });
}
