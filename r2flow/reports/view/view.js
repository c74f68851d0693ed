// Draws scans as point clouds under a shared camera, each above its range image. A scan is a texture of integers, a
// sensor a texture of directions; the vertex shader multiplies them.

const page = JSON.parse(document.getElementById("data").textContent);
const element = (id) => document.getElementById(id);
const tiles = element("tiles");
const SCALES = ["range", "height", "reflectance", "label", "error"];
const PARTS = { reflectance: "reflectance", label: "labels", error: "errors" }; // of scans, which modes need
const MODES = SCALES.filter((mode) => !PARTS[mode] || page.scans.some((scan) => scan[PARTS[mode]]));
const STEPS = page.trust.steps; // of the slider, in metres; after the last, all added points are shown
// Names and colours of errors by their number: measured, a step each, more, none.
const ERRORS = [
  page.trust.classes[0],
  ...[...STEPS, Infinity].map((step) => page.trust.classes[1 + page.trust.limits.filter((limit) => limit < step).length]),
  ["none predicted", "#808080"],
];
const UNMEASURED = "#4a5563"; // rays of the image that were not measured
const MOST_TILES = 16; // on screen
const SLOW = 90; // milliseconds per frame above which a moving camera draws fewer points
const COARSE = 5; // draw every n-th point; not a divisor of usual numbers of columns, to avoid stripes

const nameOf = (mode) => (mode === "error" ? "predicted error" : mode);

const state = {
  mode: 2 * page.scans.filter((scan) => scan.labels).length >= page.scans.length ? "label" : "height", size: 0, rings: true,
  measured: true, added: true, most: STEPS.length, frame: 0, first: 0, alone: null, picked: null, playing: false,
};
const camera = { target: [0, 0, 0], yaw: Math.PI, pitch: 0.42, distance: 30 };


// Scans

const bytesOf = (text) => Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0));

async function inflate(text) {
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Directions of a sensor's rays, (H W, 4), from elevations of rows and azimuths of columns. */
function directionsOf(rays) {
  const { rows, columns } = rays;
  const found = new Float32Array(4 * rows * columns);
  for (let i = 0; i < rows * columns; i++) {
    const e = rays.elevations[Math.floor(i / columns)];
    const a = rays.azimuths[i % columns];
    found[4 * i] = Math.cos(e) * Math.cos(a);
    found[4 * i + 1] = Math.cos(e) * Math.sin(a);
    found[4 * i + 2] = Math.sin(e);
  }
  return found;
}

/** Range code, reflectance, class and error of each pixel, (H W, 4); layout as in Python's `packed_image`. */
function texelsOf(bytes, scan, rays) {
  const { rows, columns } = rays;
  const pixels = rows * columns;
  const texels = new Uint16Array(4 * pixels);
  let planes = 2;
  const reflectance = scan.reflectance ? planes++ : 0;
  const label = scan.labels ? planes++ : 0;
  const error = scan.errors ? planes++ : 0;
  for (let i = 0, code = 0; i < pixels; i++) {
    if (i % columns === 0) code = 0;
    code = (code + 256 * bytes[i] + bytes[pixels + i]) & 65535; // differences along a row
    texels[4 * i] = code;
    if (reflectance) texels[4 * i + 1] = bytes[reflectance * pixels + i];
    if (label) texels[4 * i + 2] = bytes[label * pixels + i];
    texels[4 * i + 3] = error ? bytes[error * pixels + i] : ERRORS.length - 1;
  }
  return texels;
}

const loading = new Map();

/** Texels of a scan's frame, unpacked and uploaded once. */
function load(scan, frame) {
  const packed = scan.frames[frame];
  if (!loading.has(packed)) {
    const made = { texels: null, texture: null };
    made.ready = inflate(packed).then((bytes) => {
      const rays = page.rays[scan.rays];
      made.texels = texelsOf(bytes, scan, rays);
      made.points = new Uint32Array(ERRORS.length); // by the number of their error
      for (let i = 0; scan.errors && i < made.texels.length; i += 4) {
        if (made.texels[i]) made.points[made.texels[i + 3]]++;
        else if (made.texels[i + 3]) page.unmeasured = true; // the legend explains such rays
      }
      made.texture = texture(gl.RGBA16UI, rays.columns, rays.rows, gl.RGBA_INTEGER, gl.UNSIGNED_SHORT, made.texels);
    });
    loading.set(packed, made);
  }
  return loading.get(packed);
}

const frameOf = (scan) => Math.min(state.frame, scan.frames.length - 1);
const current = (scan) => load(scan, frameOf(scan));

/** Number up to which errors are shown. */
const most = () => (state.most < STEPS.length ? state.most + 1 : ERRORS.length);

/** Whether points of this number of an error are not shown. */
const isHidden = (scan, number) => scan.errors && (number ? !state.added || number > most() : !state.measured);


// Shaders

const COMMON = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D; precision highp sampler2D;
uniform usampler2D scan;      // range code, reflectance, class, error
uniform sampler2D directions;
uniform sampler2D colours;    // one row per mode
uniform float metres;         // per range code
uniform vec2 ranges, heights; // limits of the colour scales
uniform int mode;
uniform bool errors, measured, added; // has errors; shows measured and added points
uniform int most;                     // number up to which errors are shown
bool is_hidden(uvec4 texel) {
  return errors && (texel.a == 0u ? !measured : !added || int(texel.a) > most);
}
vec3 colour_of(uvec4 texel, float height) {
  float r = float(texel.r) * metres;
  float place = mode == 0 ? log(r / ranges.x) / log(ranges.y / ranges.x)
    : mode == 1 ? (height - heights.x) / (heights.y - heights.x)
    : sqrt(float(texel.g) / 255.0) / 0.9;
  int number = mode == 3 ? int(texel.b) : mode == 4 ? int(texel.a) : int(clamp(place * 256.0, 0.0, 255.0));
  return texelFetch(colours, ivec2(number, mode), 0).rgb;
}
`;

const POINTS = [COMMON + `
uniform mat4 camera;
uniform float scale;          // pixels per metre at a distance of one metre
uniform float spacing;        // radians between neighbouring rays
uniform float factor, least;
uniform int stride;
out vec3 colour;
void main() {
  int columns = textureSize(scan, 0).x;
  int number = gl_VertexID * stride;
  ivec2 pixel = ivec2(number % columns, number / columns);
  uvec4 texel = texelFetch(scan, pixel, 0);
  float r = float(texel.r) * metres;
  vec3 point = r * texelFetch(directions, pixel, 0).xyz;
  gl_Position = camera * vec4(point, 1.0);
  if (texel.r == 0u || is_hidden(texel)) gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside
  gl_PointSize = clamp(factor * r * spacing * scale / gl_Position.w, least, 6.0 * least);
  colour = colour_of(texel, point.z);
}`, COMMON + `
in vec3 colour;
out vec4 shown;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.27) discard; // round
  shown = vec4(colour, 1.0);
}`];

// Eye-dome lighting (Boucheny 2009): pixels are darkened by their distance behind their neighbours.
const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;
const LIGHT = [WHOLE, `#version 300 es
precision highp float; precision highp sampler2D;
uniform sampler2D drawn, depths;
uniform vec2 limits; // near and far
uniform int reach;   // pixels; 0 for no lighting
out vec4 shown;
float log_depth(ivec2 at) {
  float d = 2.0 * texelFetch(depths, at, 0).r - 1.0;
  return log2(2.0 * limits.x * limits.y / (limits.y + limits.x - d * (limits.y - limits.x)));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  shown = texelFetch(drawn, at, 0);
  if (shown.a == 0.0) discard;
  if (reach == 0) return;
  float own = log_depth(at), behind = 0.0;
  behind += max(0.0, own - log_depth(at + ivec2(reach, 0)));
  behind += max(0.0, own - log_depth(at - ivec2(reach, 0)));
  behind += max(0.0, own - log_depth(at + ivec2(0, reach)));
  behind += max(0.0, own - log_depth(at - ivec2(0, reach)));
  shown.rgb *= max(0.25, exp(-5.0 * behind));
}`];

const RINGS = [`#version 300 es
uniform mat4 camera;
uniform float radius, ground;
void main() {
  float angle = 6.2831853 * float(gl_VertexID) / 180.0;
  gl_Position = camera * vec4(radius * cos(angle), radius * sin(angle), ground, 1.0);
}`, `#version 300 es
precision highp float;
out vec4 shown;
void main() { shown = vec4(0.36, 0.41, 0.47, 1.0); }`];

const IMAGE = [WHOLE, COMMON + `
uniform vec2 corner, size; // of the image on the screen, in pixels
uniform vec3 unmeasured;   // colour
out vec4 shown;
void main() {
  ivec2 full = textureSize(scan, 0);
  vec2 at = (gl_FragCoord.xy - corner) / size;
  int row = clamp(int((1.0 - at.y) * float(full.y)), 0, full.y - 1);
  int first = int(at.x * float(full.x));
  int last = max(first + 1, int((at.x + 1.0 / size.x) * float(full.x))); // all columns on this pixel
  vec3 sum = vec3(0.0);
  for (int column = first; column < last && column < full.x; column++) {
    uvec4 texel = texelFetch(scan, ivec2(column, row), 0);
    if (texel.r == 0u) {
      if (errors && texel.a != 0u) sum += unmeasured;
      continue;
    }
    float z = float(texel.r) * metres * texelFetch(directions, ivec2(column, row), 0).z;
    sum += colour_of(texel, z) * (is_hidden(texel) ? 0.25 : 1.0);
  }
  shown = vec4(sum / float(last - first), 1.0);
}`];

const canvas = document.createElement("canvas");
const gl = canvas.getContext("webgl2", { antialias: false, depth: false, alpha: true });

function program([vertex, fragment]) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) {
    throw new Error(gl.getProgramInfoLog(made) + gl.getAttachedShaders(made).map((s) => gl.getShaderInfoLog(s)));
  }
  const places = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(made, i);
    places[name] = gl.getUniformLocation(made, name);
  }
  return { made, places };
}

function texture(format, width, height, channels, type, values) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, channels, type, values);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return made;
}

/** Framebuffer of the points: colours and depths, in the size of the canvas. */
function buffer(width, height) {
  const drawn = texture(gl.RGBA8, width, height, gl.RGBA, gl.UNSIGNED_BYTE, null);
  const depths = texture(gl.DEPTH_COMPONENT24, width, height, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
  const made = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, drawn, 0);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depths, 0);
  return { made, drawn, depths, width, height };
}


// Camera, shared by all scans: orbits a target by yaw and pitch; z is up.

const OPENING = Math.tan((25 * Math.PI) / 180); // half the vertical field of view, except in narrow views

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** Eye and axes of the camera in metres. */
function axes() {
  const { target, yaw, pitch, distance } = camera;
  const back = [Math.cos(pitch) * Math.cos(yaw), Math.cos(pitch) * Math.sin(yaw), Math.sin(pitch)];
  const right = [-Math.sin(yaw), Math.cos(yaw), 0];
  return { back, right, up: cross(back, right), eye: target.map((value, i) => value + distance * back[i]) };
}

/** Camera of a rectangle of the screen: column-major matrix from metres to clip space, and derived values. */
function lens(width, height) {
  const { back, right, up, eye } = axes();
  const half = OPENING * Math.max(1, (1.2 * height) / width);
  const near = camera.distance / 100;
  const far = camera.distance + 600;
  const x = (half * width) / height;
  const depth = [(far + near) / (far - near), (2 * far * near) / (far - near)];
  const matrix = [];
  for (let i = 0; i < 3; i++) matrix.push(right[i] / x, up[i] / half, -back[i] * depth[0], -back[i]);
  matrix.push(-dot(right, eye) / x, -dot(up, eye) / half, dot(back, eye) * depth[0] - depth[1], dot(back, eye));
  return { matrix, half, limits: [near, far] };
}

/** Position of a point in a rectangle of the screen, in pixels from the upper left, and its depth in metres. */
function project(point, width, height, { matrix } = lens(width, height)) {
  const [x, y, , w] = [0, 1, 2, 3].map((i) => dot([matrix[i], matrix[4 + i], matrix[8 + i]], point) + matrix[12 + i]);
  return { x: ((1 + x / w) * width) / 2, y: ((1 - y / w) * height) / 2, depth: w };
}

function orbit(yaw, pitch) {
  camera.yaw += yaw;
  camera.pitch = Math.min(Math.max(camera.pitch + pitch, -Math.PI / 2), Math.PI / 2);
  moved();
}

/** Move by pixels of a rectangle: what lies at its middle follows. */
function pan(x, y, width = 800, height = 600) {
  const { right, up } = axes();
  const metres = (2 * lens(width, height).half * camera.distance) / height;
  camera.target = camera.target.map((value, i) => value - metres * (x * right[i] - y * up[i]));
  moved();
}

function zoom(factor) {
  camera.distance = Math.min(Math.max(camera.distance * factor, 0.5), 500);
  moved();
}

function reset() {
  const { clientWidth: width, clientHeight: height } = shownScans()[0].points;
  const pitch = width < height ? 0.75 : 0.42; // a steeper view fills tall rectangles
  Object.assign(camera, { target: [0.28 * home, 0, -0.04 * home], yaw: Math.PI, pitch, distance: home });
  moved();
}

function top() {
  Object.assign(camera, { target: [0, 0, 0], yaw: Math.PI, pitch: Math.PI / 2, distance: 2.2 * home });
  moved();
}

const ground = page.heights[0] + 0.5; // height of the rings: that below which 2 % of the points lie
let home = 30; // default distance of the camera in metres

let radii = []; // of the rings, in metres: up to five, in steps of 1, 2, 5, 10, 20 or 50

function findRings() {
  const reach = page.ranges[1] / 1.1;
  const step = [1, 2, 5, 10, 20].find((metres) => reach / metres < 6) ?? 50;
  radii = Array.from({ length: Math.max(1, Math.floor(reach / step)) }, (_, i) => step * (i + 1));
}

/** Set the default distance by the median range of the first scan. */
function findHome() {
  const { texels } = current(page.scans[0]);
  const codes = texels.filter((_, i) => i % 4 === 0 && texels[i] > 0).sort();
  if (codes.length) home = Math.min(Math.max(2.8 * codes[codes.length >> 1] * page.metres, 6), 60);
}


// Drawing

let points, light, rings, image, colours, into;
let asked = false;
let moving = false;
let late = 0; // consecutive slow frames while the camera moved
let last = 0;
let resting;

function redraw() {
  if (!asked) requestAnimationFrame(draw);
  asked = true;
}

/** Redraw after a movement of the camera. */
function moved() {
  moving = true;
  clearTimeout(resting);
  redraw();
}

/** Redraw with all points when the camera rests. */
function rest() {
  moving = false;
  redraw();
}

function rectangle(part, ratio) {
  const box = part.getBoundingClientRect();
  const whole = tiles.getBoundingClientRect();
  const [left, right] = [box.left - whole.left, box.right - whole.left].map((x) => Math.round(x * ratio));
  const [above, below] = [box.top - whole.top, box.bottom - whole.top].map((y) => Math.round(y * ratio));
  return [left, canvas.height - below, right - left, below - above];
}

function draw(now) {
  asked = false;
  if (late < 3) late = moving && now - last > SLOW ? late + 1 : 0;
  last = moving ? now : Infinity;
  const coarse = moving && late === 3;
  clearTimeout(resting);
  if (moving) resting = setTimeout(rest, 250);
  const ratio = Math.min(devicePixelRatio, 2);
  const [width, height] = [tiles.clientWidth, tiles.clientHeight].map((length) => Math.round(length * ratio));
  if (!width || !height) return;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  if (!into || into.width !== width || into.height !== height) {
    if (into) [into.drawn, into.depths].forEach((one) => gl.deleteTexture(one));
    into = buffer(width, height);
  }
  const seen = shownScans().filter((scan) => current(scan).texture);
  gl.enable(gl.SCISSOR_TEST);
  gl.bindFramebuffer(gl.FRAMEBUFFER, into.made);
  gl.enable(gl.DEPTH_TEST);
  let limits = [1, 2];
  gl.useProgram(points.made);
  for (const scan of seen) {
    const box = rectangle(scan.points, ratio);
    if (!begin(box)) continue;
    const view = lens(box[2], box[3]);
    const rays = bind(points, scan);
    limits = view.limits;
    gl.uniformMatrix4fv(points.places.camera, false, view.matrix);
    gl.uniform1f(points.places.scale, box[3] / (2 * view.half));
    gl.uniform1f(points.places.spacing, rays.spacing);
    gl.uniform1f(points.places.factor, 1.6 * 2 ** state.size * (coarse ? 1.5 : 1));
    gl.uniform1f(points.places.least, ratio * 2 ** (state.size / 2));
    const stride = coarse ? COARSE : 1;
    gl.uniform1i(points.places.stride, stride);
    gl.drawArrays(gl.POINTS, 0, Math.floor((rays.rows * rays.columns) / stride));
  }
  gl.useProgram(rings.made);
  gl.uniform1f(rings.places.ground, ground);
  for (const scan of state.rings ? seen : []) {
    const box = rectangle(scan.points, ratio);
    gl.viewport(...box);
    gl.scissor(...box);
    gl.uniformMatrix4fv(rings.places.camera, false, lens(box[2], box[3]).matrix);
    for (const radius of radii) {
      gl.uniform1f(rings.places.radius, radius);
      gl.drawArrays(gl.LINE_LOOP, 0, 180);
    }
  }
  gl.disable(gl.DEPTH_TEST);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  begin([0, 0, width, height]);
  gl.useProgram(light.made);
  [into.drawn, into.depths].forEach((one, unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, one);
  });
  gl.uniform1i(light.places.drawn, 0);
  gl.uniform1i(light.places.depths, 1);
  gl.uniform2f(light.places.limits, ...limits);
  gl.uniform1i(light.places.reach, coarse ? 0 : Math.round(ratio));
  for (const scan of seen) {
    gl.viewport(0, 0, width, height);
    gl.scissor(...rectangle(scan.points, ratio));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
  gl.useProgram(image.made);
  for (const scan of seen) {
    const box = rectangle(scan.image, ratio);
    if (!begin(box)) continue;
    bind(image, scan);
    gl.uniform3f(image.places.unmeasured, ...partsOf(UNMEASURED).map((part) => part / 255));
    gl.uniform2f(image.places.corner, box[0], box[1]);
    gl.uniform2f(image.places.size, box[2], box[3]);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
  place();
}

/** Restrict drawing to a rectangle, and clear it. */
function begin(box) {
  if (box[2] < 1 || box[3] < 1) return false;
  gl.viewport(...box);
  gl.scissor(...box);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  return true;
}

function bind({ places }, scan) {
  const rays = page.rays[scan.rays];
  [current(scan).texture, rays.texture, colours].forEach((one, unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, one);
  });
  gl.uniform1i(places.scan, 0);
  gl.uniform1i(places.directions, 1);
  gl.uniform1i(places.colours, 2);
  gl.uniform1f(places.metres, page.metres);
  gl.uniform2f(places.ranges, ...page.ranges);
  gl.uniform2f(places.heights, ...page.heights);
  gl.uniform1i(places.mode, SCALES.indexOf(state.mode));
  gl.uniform1i(places.measured, state.measured);
  gl.uniform1i(places.added, state.added);
  gl.uniform1i(places.most, most());
  gl.uniform1i(places.errors, scan.errors);
  return rays;
}


// Picking of the pixel under the cursor, in the image or among the points; shown in all scans of the same rays.

function pointOf(scan, pixel) {
  const { texels } = current(scan);
  const { directions } = page.rays[scan.rays];
  if (!texels || !texels[4 * pixel]) return null;
  const r = texels[4 * pixel] * page.metres;
  return [0, 1, 2].map((i) => r * directions[4 * pixel + i]);
}

/** The pixel whose point is foremost within some pixels of a position on the screen. */
function pickPoint(scan, x, y) {
  const { texels } = current(scan);
  if (!texels) return null;
  const { directions } = page.rays[scan.rays];
  const { clientWidth: width, clientHeight: height } = scan.points;
  const { matrix: m } = lens(width, height);
  let [best, score] = [null, Infinity];
  for (let i = 0; i < texels.length; i += 4) {
    if (!texels[i] || isHidden(scan, texels[i + 3])) continue;
    const r = texels[i] * page.metres;
    const [px, py, pz] = [r * directions[i], r * directions[i + 1], r * directions[i + 2]];
    const w = m[3] * px + m[7] * py + m[11] * pz + m[15];
    if (w < 0.1) continue;
    const dx = ((1 + (m[0] * px + m[4] * py + m[8] * pz + m[12]) / w) * width) / 2 - x;
    const dy = ((1 - (m[1] * px + m[5] * py + m[9] * pz + m[13]) / w) * height) / 2 - y;
    const off = dx * dx + dy * dy;
    if (off > 64) continue;
    const found = w * (1 + off / 20); // prefers points close to camera and cursor
    if (found < score) [best, score] = [i / 4, found];
  }
  return best;
}

function pickImage(scan, x, y) {
  const { rows, columns } = page.rays[scan.rays];
  const row = Math.floor((y / scan.image.clientHeight) * rows);
  const column = Math.floor((x / scan.image.clientWidth) * columns);
  return row >= 0 && row < rows && column >= 0 && column < columns ? row * columns + column : null;
}

function pick(scan, pixel) {
  state.picked = pixel === null ? null : { scan, pixel };
  place();
}

/** Mark the picked pixel in every scan, and show its values. */
function place() {
  const picked = state.picked;
  for (const scan of shownScans()) {
    const same = picked && scan.rays === picked.scan.rays;
    const point = same ? pointOf(scan, picked.pixel) : null;
    const { rows, columns } = page.rays[scan.rays];
    const at = point && project(point, scan.points.clientWidth, scan.points.clientHeight);
    put(scan.pointMark, at && at.depth > 0 && !isHidden(scan, current(scan).texels[4 * picked.pixel + 3]) ? at : null);
    placeRings(scan);
    const [row, column] = same ? [Math.floor(picked.pixel / columns), picked.pixel % columns] : [0, 0];
    const [width, height] = [scan.image.clientWidth / columns, scan.image.clientHeight / rows];
    put(scan.imageMark, same ? { x: (column + 0.5) * width, y: (row + 0.5) * height } : null);
  }
  element("readout").textContent = picked ? readout(picked) : "";
}

/** Write the metres of the rings, ahead of the camera and a little to its right, where there is room. */
function placeRings(scan) {
  const { clientWidth: width, clientHeight: height } = scan.points;
  const angle = camera.yaw + Math.PI - 0.5;
  let last = null;
  radii.forEach((radius, i) => {
    const at = project([radius * Math.cos(angle), radius * Math.sin(angle), ground], width, height);
    const inside = at.depth > 0 && at.x > 16 && at.x < width - 16 && at.y > 8 && at.y < height - 8;
    const room = inside && (!last || Math.hypot(at.x - last.x, at.y - last.y) > 26);
    put(scan.rings[i], state.rings && room ? at : null);
    if (room) last = at;
  });
}

function put(mark, at) {
  mark.hidden = !at;
  if (at) Object.assign(mark.style, { left: `${at.x}px`, top: `${at.y}px` });
}

function readout({ scan, pixel }) {
  const { columns } = page.rays[scan.rays];
  const { texels } = current(scan);
  const where = `row ${Math.floor(pixel / columns)}, column ${pixel % columns}`;
  const point = pointOf(scan, pixel);
  const number = texels[4 * pixel + 3];
  if (!point) return `${where}: ${scan.errors && number ? "not measured" : "no return"}`;
  const said = [where, `${Math.hypot(...point).toFixed(2)} m`, `height ${point[2].toFixed(2)} m`];
  if (scan.reflectance) said.push(`reflectance ${(texels[4 * pixel + 1] / 255).toFixed(2)}`);
  if (scan.labels) said.push(page.classes[texels[4 * pixel + 2]][0]);
  if (scan.errors) said.push(number ? `added${errorName(number)}` : "measured");
  return said.join(" · ");
}


function errorName(number) {
  if (number === ERRORS.length - 1) return "";
  return number <= STEPS.length ? `, error up to ${STEPS[number - 1]} m` : `, error above ${STEPS.at(-1)} m`;
}


// Tiles

function node(kind, parent, properties = {}) {
  const made = Object.assign(document.createElement(kind), properties);
  parent.append(made);
  return made;
}

function buildTile(scan) {
  scan.tile = document.createElement("figure");
  const caption = node("figcaption", scan.tile);
  node("span", caption, { textContent: scan.caption, title: scan.caption });
  scan.note = node("small", caption);
  if (page.scans.length > 1) {
    const button = node("button", caption, { textContent: "⤢", title: "Alone, or beside the others: double click" });
    button.setAttribute("aria-label", `show ${scan.caption} alone, or all`);
    button.onclick = () => showAlone(scan);
  }
  scan.points = node("div", scan.tile, { className: "points" });
  scan.image = node("div", scan.tile, { className: "image" });
  scan.pointMark = node("div", scan.points, { className: "mark", hidden: true });
  scan.rings = radii.map((radius) => node("div", scan.points, { className: "ring", hidden: true, textContent: `${radius} m` }));
  scan.imageMark = node("div", scan.image, { className: "mark", hidden: true });
  caption.ondblclick = () => showAlone(scan);
  followPoints(scan);
  followImage(scan);
}

function showAlone(scan) {
  if (page.scans.length < 2) return;
  state.alone = state.alone ? null : scan;
  arrange();
}

/** Columns, rows and number of tiles for large tiles with an aspect ratio of about 1.7. */
function gridOf(count, width, height) {
  const most = Math.min(count, MOST_TILES, Math.max(1, Math.floor(width / 150) * Math.floor(height / 118)));
  let best = { score: -1 };
  for (let across = 1; across <= most; across++) {
    const down = Math.ceil(most / across);
    const [w, h] = [width / across, height / down];
    const score = Math.min(w, 1.7 * h) - 2 * (across * down - most);
    if (score > best.score) best = { score, across, down, most };
  }
  return best;
}

let perPage = MOST_TILES;
const shownScans = () => (state.alone ? [state.alone] : page.scans.slice(state.first, state.first + perPage));

function arrange() {
  late = 0;
  const grid = gridOf(state.alone ? 1 : page.scans.length, tiles.clientWidth, tiles.clientHeight);
  if (!state.alone) {
    perPage = grid.most;
    state.first = Math.min(perPage * Math.floor(state.first / perPage), page.scans.length - 1);
  }
  tiles.style.gridTemplateColumns = `repeat(${grid.across}, minmax(0, 1fr))`;
  tiles.style.gridTemplateRows = `repeat(${grid.down}, minmax(0, 1fr))`;
  tiles.replaceChildren(canvas, ...shownScans().map((scan) => scan.tile));
  for (const scan of shownScans()) {
    const { rows, columns } = page.rays[scan.rays];
    const high = Math.max((scan.tile.clientWidth * rows) / columns, 22);
    scan.image.style.height = `${Math.round(Math.min(high, 0.3 * scan.tile.clientHeight))}px`;
  }
  const end = Math.min(state.first + perPage, page.scans.length);
  element("pager").hidden = perPage >= page.scans.length || state.alone !== null;
  element("page-name").textContent = `${state.first + 1} to ${end} of ${page.scans.length}`;
  return show();
}

function turn(by) {
  const first = state.first + by * perPage;
  if (first >= 0 && first < page.scans.length) state.first = first;
  arrange();
}

/** Draw as soon as all visible frames are unpacked. */
async function show() {
  await Promise.all(shownScans().map((scan) => current(scan).ready));
  count();
  setMode(state.mode);
}


// Mouse, touch, keyboard

function followPoints(scan) {
  const held = new Map(); // pointers that are down, by id
  let path = 0;
  const box = scan.points;
  const at = (event) => [event.offsetX, event.offsetY];
  box.addEventListener("pointerdown", (event) => {
    box.setPointerCapture(event.pointerId);
    held.set(event.pointerId, at(event));
    path = held.size > 1 ? Infinity : 0;
  });
  box.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    const now = at(event);
    if (!before) return void (event.pointerType !== "touch" && pick(scan, pickPoint(scan, ...now)));
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    const other = [...held].find(([id]) => id !== event.pointerId);
    if (other) {
      const distance = (point) => Math.hypot(point[0] - other[1][0], point[1] - other[1][1]);
      if (distance(now) > 8) zoom(distance(before) / distance(now));
      pan(dx / 2, dy / 2, box.clientWidth, box.clientHeight);
    } else if (event.shiftKey || event.buttons & 6) pan(dx, dy, box.clientWidth, box.clientHeight);
    else orbit(-dx * 0.008, dy * 0.008);
    path += Math.abs(dx) + Math.abs(dy);
    held.set(event.pointerId, now);
  });
  const released = (event) => {
    if (held.delete(event.pointerId) && event.pointerType === "touch" && path < 8) pick(scan, pickPoint(scan, ...at(event)));
  };
  box.addEventListener("pointerup", released);
  box.addEventListener("pointercancel", (event) => held.delete(event.pointerId));
  box.addEventListener("pointerleave", (event) => event.pointerType !== "touch" && !held.size && pick(scan, null));
  box.addEventListener("contextmenu", (event) => event.preventDefault());
  box.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(Math.max(-150, Math.min(150, event.deltaMode ? 30 * event.deltaY : event.deltaY)) * 0.0015));
  }, { passive: false });
  box.addEventListener("dblclick", (event) => lookAt(scan, pickPoint(scan, ...at(event))));
}

function followImage(scan) {
  const follow = (event) => pick(scan, pickImage(scan, event.offsetX, event.offsetY));
  scan.image.addEventListener("pointermove", follow);
  scan.image.addEventListener("pointerdown", follow);
  scan.image.addEventListener("pointerleave", (event) => event.pointerType !== "touch" && pick(scan, null));
  scan.image.addEventListener("dblclick", (event) => {
    lookAt(scan, pickImage(scan, event.offsetX, event.offsetY));
  });
}

/** Orbit a pixel's point. */
function lookAt(scan, pixel) {
  const point = pixel === null ? null : pointOf(scan, pixel);
  if (!point) return;
  camera.target = point;
  moved();
}

const KEYS = {
  ArrowLeft: ["turn", () => orbit(-0.09, 0), () => pan(40, 0)],
  ArrowRight: ["turn", () => orbit(0.09, 0), () => pan(-40, 0)],
  ArrowUp: ["higher", () => orbit(0, 0.07), () => pan(0, 40)],
  ArrowDown: ["lower", () => orbit(0, -0.07), () => pan(0, -40)],
  "+": ["nearer", () => zoom(0.85)],
  "=": ["nearer", () => zoom(0.85)],
  "-": ["farther", () => zoom(1 / 0.85)],
  r: ["reset the camera", reset],
  t: ["from above", top],
  c: ["next colour", () => setMode(MODES[(MODES.indexOf(state.mode) + 1) % MODES.length])],
  m: ["measured points", () => choose({ measured: !state.measured })],
  a: ["added points", () => choose({ added: !state.added })],
  e: ["smaller error", () => choose({ most: state.most - 1 }), () => choose({ most: state.most + 1 })],
  g: ["rings", () => setRings(!state.rings)],
  "[": ["smaller points", () => setSize(state.size - 0.5)],
  "]": ["larger points", () => setSize(state.size + 0.5)],
  " ": ["play", () => play(!state.playing)],
  ",": ["frame before", () => setFrame(state.frame - 1)],
  ".": ["next frame", () => setFrame(state.frame + 1)],
  PageUp: ["scans before", () => turn(-1)],
  PageDown: ["next scans", () => turn(1)],
  Escape: ["all scans again", () => { state.alone = null; arrange(); }],
  d: ["dark or light", () => setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark")],
  "?": ["this list", help],
};

const HELP = [
  ["drag", "turn"], ["right button, Shift, two fingers", "move"], ["wheel, pinch", "nearer and farther"],
  ["double click", "turn about that point"], ["arrows", "turn; with Shift, move"], ["+ −", "nearer, farther"],
  ["R", "reset the camera"], ["T", "view from above"], ["C", "next colour"], ["[ ]", "point size"],
  ["G", "rings of distance"],
  ...(MODES.includes("error") ? [["M, A", "measured, added points on or off"], ["E, Shift+E", "largest predicted error: smaller, larger"]] : []),
  ["Space , .", "play, frame before, next frame"], ["Page up, Page down", "other scans"],
  ["Esc", "all scans again"], ["D", "dark or light"],
];

function help() {
  const box = element("keys");
  if (box.open) return box.close();
  element("help").setAttribute("aria-expanded", "true");
  box.onclose = () => element("help").setAttribute("aria-expanded", "false");
  const table = document.createElement("table");
  for (const [key, meaning] of HELP) {
    const row = node("tr", table);
    node("td", row, { textContent: key });
    node("td", row, { textContent: meaning });
  }
  box.replaceChildren(table);
  box.onclick = () => box.close();
  box.showModal();
}

addEventListener("keydown", (event) => {
  const own = { INPUT: /^(Arrow|Page)/, BUTTON: /^ $/ }[event.target.tagName]?.test(event.key); // its default action
  const action = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!action || own || event.ctrlKey || event.metaKey || event.altKey) return;
  if (element("keys").open && event.key !== "?") return;
  event.preventDefault();
  (event.shiftKey && action[2] ? action[2] : action[1])();
});


// Controls

function setMode(mode) {
  state.mode = mode;
  for (const button of element("modes").children) {
    button.setAttribute("aria-pressed", button.textContent === nameOf(mode));
  }
  const legend = element("legend");
  legend.replaceChildren();
  const say = (text) => node("span", legend, { textContent: text });
  const name = ([text, colour]) => {
    const entry = say("");
    node("b", entry).style.background = colour;
    entry.append(text);
  };
  for (const scan of page.scans) scan.note.textContent = PARTS[mode] && !scan[PARTS[mode]] ? `no ${nameOf(mode)}` : "";
  if (mode === "label") {
    const [none, ...classes] = page.classes;
    [...new Map(classes), none].forEach(name);
  } else if (mode === "error") {
    say(page.trust.title);
    [...new Map(ERRORS)].forEach(name);
  } else {
    const row = SCALES.indexOf(mode);
    const ends = { range: page.ranges, height: page.heights, reflectance: [0, 0.81] }[mode];
    const unit = mode === "reflectance" ? "" : " m";
    const [low, high] = ends;
    const middle = { range: Math.sqrt(low * high), height: (low + high) / 2, reflectance: high / 4 }[mode];
    const stops = Array.from({ length: 17 }, (_, i) => 1024 * row + 4 * Math.min(16 * i, 255));
    const bar = (part) => {
      node("i", legend).style.background =
        `linear-gradient(90deg, ${part.map((i) => `rgb(${table.slice(i, i + 3).join(" ")})`)})`;
    };
    const rounded = (value) => `${Number(value.toPrecision(2))}${unit}`;
    say(`${mode} ${rounded(low)}`);
    bar(stops.slice(0, 9));
    say(rounded(middle)); // range is on a logarithmic scale, reflectance on that of its root
    bar(stops.slice(8));
    say(rounded(high));
  }
  if (page.unmeasured) [["not measured", UNMEASURED], ["no return", "#000000"]].forEach(name);
  redraw();
}

function setSize(size) {
  state.size = Math.min(Math.max(size, -2), 2);
  element("size").value = state.size;
  redraw();
}

/** Which points of completed scans are shown: measured, added, and these up to a step of their error. */
function choose(change) {
  Object.assign(state, change);
  state.most = Math.min(Math.max(state.most, 0), STEPS.length);
  for (const kind of ["measured", "added"]) element(kind).setAttribute("aria-pressed", state[kind]);
  element("error").value = state.most;
  count();
  redraw();
}

/** Say how many added points of the scans on screen the slider leaves. */
function count() {
  const points = new Uint32Array(ERRORS.length);
  for (const scan of shownScans()) current(scan).points?.forEach((number, i) => { points[i] += number; });
  const upTo = (last) => points.slice(1, last + 1).reduce((total, number) => total + number, 0);
  const share = upTo(most()) / Math.max(upTo(ERRORS.length), 1);
  const limit = state.most < STEPS.length ? `${STEPS[state.most]} m` : "any";
  const text = `${limit}: ${Math.round(100 * share)} %`;
  element("kept").textContent = text;
  element("kept").title = `${text} of ${upTo(ERRORS.length).toLocaleString("en")} added points are shown`;
  element("error").setAttribute("aria-valuetext", element("kept").title);
}

function setRings(on) {
  state.rings = on;
  element("rings").setAttribute("aria-pressed", on);
  redraw();
}

const frames = Math.max(...page.scans.map((scan) => scan.frames.length));

const frameName = () => page.frames[state.frame] ?? `${state.frame + 1} of ${frames}`;

async function setFrame(frame) {
  state.frame = Math.min(Math.max(frame, 0), frames - 1);
  element("frame").value = state.frame;
  element("frame-name").textContent = frameName();
  await show();
}

function play(on) {
  if (frames < 2) return;
  state.playing = on;
  element("play").textContent = on ? "❚❚" : "▶";
  clearInterval(play.timer);
  if (on) play.timer = setInterval(() => setFrame((state.frame + 1) % frames), 400);
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  redraw();
}

function buildControls() {
  for (const mode of MODES) node("button", element("modes"), { textContent: nameOf(mode), onclick: () => setMode(mode) });
  element("size").oninput = (event) => setSize(Number(event.target.value));
  element("kinds").hidden = !MODES.includes("error");
  for (const kind of ["measured", "added"]) element(kind).onclick = () => choose({ [kind]: !state[kind] });
  element("error").max = STEPS.length;
  element("error").oninput = (event) => choose({ most: Number(event.target.value) });
  element("rings").onclick = () => setRings(!state.rings);
  element("reset").onclick = reset;
  element("top").onclick = top;
  element("theme").onclick = KEYS.d[1];
  element("help").onclick = help;
  element("previous").onclick = () => turn(-1);
  element("next").onclick = () => turn(1);
  element("player").hidden = frames < 2;
  element("frame").max = frames - 1;
  element("frame").oninput = (event) => { play(false); setFrame(Number(event.target.value)); };
  element("play").onclick = () => play(!state.playing);
  const light = matchMedia("(prefers-color-scheme: light)");
  setTheme(light.matches ? "light" : "dark");
  light.onchange = () => setTheme(light.matches ? "light" : "dark");
}

const table = new Uint8Array(4 * 256 * SCALES.length); // one row of 256 colours per mode

const partsOf = (colour) => [1, 3, 5].map((place) => parseInt(colour.slice(place, place + 2), 16));

function prepare() {
  table.set(bytesOf(page.colours));
  [page.classes, ERRORS].forEach((classes, row) => {
    classes.forEach(([, colour], i) => table.set([...partsOf(colour), 255], 4 * ((3 + row) * 256 + i)));
  });
  [points, light, rings, image] = [POINTS, LIGHT, RINGS, IMAGE].map(program);
  colours = texture(gl.RGBA8, 256, SCALES.length, gl.RGBA, gl.UNSIGNED_BYTE, table);
  for (const rays of page.rays) {
    rays.directions ??= directionsOf(rays);
    rays.texture = texture(gl.RGBA32F, rays.columns, rays.rows, gl.RGBA, gl.FLOAT, rays.directions);
  }
}

function trouble(text) {
  Object.assign(element("trouble"), { textContent: text, hidden: false });
}

async function start() {
  buildControls();
  if (!gl || typeof DecompressionStream === "undefined") {
    return trouble("This page needs WebGL 2 and a browser of 2023 or later.");
  }
  prepare();
  findRings();
  page.scans.forEach(buildTile);
  setMode(state.mode);
  setRings(true);
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    into = null;
    loading.clear();
    prepare();
    show();
  });
  element("frame-name").textContent = frameName();
  await current(page.scans[0]).ready;
  findHome();
  await arrange();
  choose({});
  reset();
  new ResizeObserver(arrange).observe(tiles);
  requestAnimationFrame(() => { document.documentElement.dataset.ready = Math.round(performance.now()); });
}

window.view = { page, camera, state, project, lens, redraw, draw, gl }; // for the console
start().catch((error) => trouble(`This page cannot be drawn: ${error.message}`));
