(() => {
"use strict";
const root = document.querySelector("[data-player]");
const cases = JSON.parse(document.getElementById("replay-data").textContent);
const part = name => root.querySelector(`[data-replay="${name}"]`);
const scene = part("scene"), trace = part("trace"), pilots = part("pilots"), scrub = part("scrub");
const playButton = part("play"), clock = part("time"), hint = part("hint");
const rate = part("rate"), gain = part("gain"), chooser = part("case"), pair = part("pair"), left = part("left"), right = part("right");
const both = part("beside"), beside = () => both.getAttribute("aria-pressed") === "true" && flown.tracks.length > 1;
const speeds = part("speeds"), seeds = part("seeds");
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const TRAIL = 2.5, MARGIN = { left: 46, right: 8, top: 8, bottom: 18 };

// ---- data ---------------------------------------------------------------------------------------------------------
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
const shorts = (text, scale) => Float32Array.from(new Int16Array(bytes(text)), v => v * scale);
function decode(packed) {
  if (packed.ready) return packed;
  packed.path = shorts(packed.reference, packed.reference_step);
  for (const track of packed.tracks) {
    track.offset = shorts(track.error, track.error_step);
    track.quaternion = shorts(track.attitude, 1 / 32767);
    track.share = Float32Array.from(new Uint8Array(bytes(track.thrust)), v => v / 255);
    track.size = new Float32Array(track.samples);
    if (track.wind) track.air = shorts(track.wind, track.wind_step);
    if (track.estimate) track.told = shorts(track.estimate, track.estimate_step);
    for (let i = 0; i < track.samples; i++) track.size[i] = 1e3 * Math.hypot(...track.offset.subarray(3 * i, 3 * i + 3));
    track.shown = true;
  }
  const low = [0, 1, 2].map(a => column(packed.path, a, Math.min)), high = [0, 1, 2].map(a => column(packed.path, a, Math.max));
  packed.low = low; packed.high = high;
  packed.radius = Math.max(0.5, Math.hypot(...low.map((l, a) => high[a] - l)) / 2);
  packed.arm = Math.max(...packed.rotors.map(r => Math.hypot(...r)));
  packed.gale = Math.max(0, ...packed.tracks.filter(t => t.air).map(t => {
    let most = 0;
    for (let i = 0; i < t.samples; i++) most = Math.max(most, Math.hypot(...t.air.subarray(3 * i, 3 * i + 3)));
    return most;
  }));
  packed.duration = (packed.samples - 1) * packed.step;
  packed.ready = true;
  return packed;
}
const column = (array, axis, pick) => { let m = array[axis]; for (let i = axis; i < array.length; i += 3) m = pick(m, array[i]); return m; };
function lerp(array, width, at, n) {
  const i = Math.min(Math.floor(at), n - 1), j = Math.min(i + 1, n - 1), f = Math.min(at - i, 1), out = new Array(width);
  for (let a = 0; a < width; a++) out[a] = array[width * i + a] * (1 - f) + array[width * j + a] * f;
  return out;
}

// ---- state --------------------------------------------------------------------------------------------------------
let flown, time = 0, playing = false, before = 0, frame = 0, colours = {};
const VIEWS = { orbit: [-0.7, 0.5], top: [0, Math.PI / 2 - 1e-3], side: [0, 0.02], chase: [-0.7, 0.35] };
const camera = { yaw: -0.7, pitch: 0.5, zoom: 1, view: "orbit", centre: [0, 0, 0], rise: 0.54, fit: 0, fitted: "" };
function readColours() {
  const style = getComputedStyle(document.documentElement), names = ["panel", "ink", "muted", "rule", "accent"];
  for (const c of cases) for (const track of c.tracks) names.push(`series-${track.colour}`);
  colours = Object.fromEntries(names.map(n => [n, style.getPropertyValue(`--${n}`).trim()]));
}
const colourOf = track => colours[`series-${track.colour}`];

// ---- geometry -----------------------------------------------------------------------------------------------------
let eye = null;
function aim(width, height) {
  const cy = Math.cos(camera.yaw), sy = Math.sin(camera.yaw), cp = Math.cos(camera.pitch), sp = Math.sin(camera.pitch);
  const reach = flown.radius * (camera.view === "chase" ? 0.4 : 1);
  const [x0, y0, z0] = camera.centre;
  const through = scale => (x, y, z) => {
    x -= x0; y -= y0; z -= z0;
    const right = cy * x - sy * y, away = sy * x + cy * y, depth = away * cp - z * sp, up = away * sp + z * cp;
    const far = 2.6 + depth / reach;
    if (far < 0.15) return null;
    const f = scale * camera.zoom / far;
    return [width / 2 + right * f, height * camera.rise - up * f, f, depth];
  };
  if (!camera.fit || camera.fitted !== `${width} ${height}`) {
    camera.fit = camera.view === "chase" ? 1.3 * height / reach : fitted(through(1), width, height);
    camera.fitted = `${width} ${height}`;
  }
  eye = through(camera.fit);
}
function fitted(see, width, height) { // the scale at which the whole reference fills the picture
  const box = [Infinity, Infinity, -Infinity, -Infinity], kept = camera.zoom;
  camera.zoom = 1;
  for (let i = 0; i < flown.samples; i += 4) {
    const [x, y] = see(flown.path[3 * i], flown.path[3 * i + 1], flown.path[3 * i + 2]) || [width / 2, height / 2];
    box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y); box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
  }
  camera.zoom = kept;
  const across = 2 * Math.max(box[2] - width / 2, width / 2 - box[0], 1e-9), middle = height * camera.rise;
  const up = 2 * Math.max(box[3] - middle, middle - box[1], 1e-9), size = droneSize() * 3;
  return Math.min(0.86 * width / across, 0.66 * height / up, 1.1 * Math.min(width, height) / size);
}
const turn = ([w, x, y, z], [a, b, c]) => {
  const tx = 2 * (y * c - z * b), ty = 2 * (z * a - x * c), tz = 2 * (x * b - y * a);
  return [a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx];
};
function place(track, at, offset = track.offset) {
  const g = +gain.value, p = lerp(flown.path, 3, at, flown.samples), e = lerp(offset, 3, at, track.samples);
  return p.map((v, a) => v + g * e[a]);
}

// ---- drawing ------------------------------------------------------------------------------------------------------
function surface(canvas) {
  const ratio = Math.min(devicePixelRatio || 1, 2), w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  }
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.clearRect(0, 0, w, h);
  g.lineJoin = g.lineCap = "round";
  return [g, w, h];
}
function stroke(g, points, colour, width, alpha = 1, dash = []) {
  g.strokeStyle = colour; g.lineWidth = width; g.globalAlpha = alpha; g.setLineDash(dash);
  g.beginPath();
  let pen = false;
  for (const p of points) {
    if (!p) { pen = false; continue; }
    pen ? g.lineTo(p[0], p[1]) : g.moveTo(p[0], p[1]);
    pen = true;
  }
  g.stroke(); g.setLineDash([]); g.globalAlpha = 1;
}
const nice = v => { const p = 10 ** Math.floor(Math.log10(v)); return [1, 2, 5, 10].map(s => s * p).find(s => s >= v); };
function ground(g) {
  const cell = nice(flown.radius / 5), z = flown.low[2] - Math.max(0.06 * flown.radius, 0.35 * droneSize());
  const n = 9, cx = Math.round(camera.centre[0] / cell) * cell, cy = Math.round(camera.centre[1] / cell) * cell;
  for (let i = -n; i <= n; i++) {
    for (const flip of [0, 1]) {
      const line = [];
      for (let j = -n; j <= n; j++) line.push(flip ? eye(cx + j * cell, cy + i * cell, z) : eye(cx + i * cell, cy + j * cell, z));
      stroke(g, line, colours.rule, 1, 1 - 0.75 * Math.abs(i) / n);
    }
  }
  const shadow = [];
  for (let i = 0; i < flown.samples; i++) shadow.push(eye(flown.path[3 * i], flown.path[3 * i + 1], z));
  stroke(g, shadow, colours.muted, 2, 0.18);
  return [cell, z];
}
const droneSize = () => Math.max(flown.arm, 0.075 * flown.radius * (camera.view === "chase" ? 0.5 : 1));
function drone(g, track, at, floor) {
  const grown = droneSize() / flown.arm, p = place(track, at), q = lerp(track.quaternion, 4, at, track.samples);
  const share = lerp(track.share, flown.rotors.length, at, track.samples), colour = colourOf(track);
  const world = v => turn(q, v).map((c, a) => c + p[a]);
  const middle = eye(...p);
  if (!middle) return;
  stroke(g, [middle, eye(p[0], p[1], floor)], colour, 1, 0.35, [2, 3]);
  const below = eye(p[0], p[1], floor);
  if (below) { g.globalAlpha = 0.3; g.fillStyle = colour; g.beginPath(); g.arc(below[0], below[1], 3, 0, 7); g.fill(); g.globalAlpha = 1; }
  flown.rotors.forEach((r, n) => {
    const hub = r.map(v => v * grown), disc = [], size = 0.5 * droneSize();
    const tip = world(hub);
    for (let k = 0; k <= 20; k++) {
      const a = k * Math.PI / 10;
      disc.push(eye(...world([hub[0] + size * Math.cos(a), hub[1] + size * Math.sin(a), hub[2]])));
    }
    stroke(g, [middle, eye(...tip)], colour, 2.4);
    g.fillStyle = colours.panel; g.globalAlpha = 0.55; g.beginPath();
    disc.forEach((d, k) => d && (k ? g.lineTo(d[0], d[1]) : g.moveTo(d[0], d[1]))); g.fill();
    stroke(g, disc, colour, 1.5);
    const top = full => eye(...world([hub[0], hub[1], hub[2] + 1.9 * droneSize() * full]));
    stroke(g, [eye(...tip), top(1)], colour, 3, 0.14);
    stroke(g, [eye(...tip), top(share[n])], colour, 3);
  });
  const nose = eye(...world([1.25 * droneSize(), 0, 0]));
  stroke(g, [middle, nose], colours.ink, 1.5, 0.8);
}
function arrow(g, from, to, colour) {
  if (!from || !to) return;
  stroke(g, [from, to], colour, 2, 0.9);
  const x = to[0] - from[0], y = to[1] - from[1], long = Math.hypot(x, y);
  if (long < 2) return;
  const barb = Math.min(9, 0.5 * long) / long, side = s => [to[0] - barb * (x + s * 0.6 * y), to[1] - barb * (y - s * 0.6 * x)];
  stroke(g, [side(1), to, side(-1)], colour, 2, 0.9);
}
function wind(g, track, at) { // blows towards the vehicle; the strongest of all flights is three vehicles long
  const v = lerp(track.air, 3, at, track.samples), speed = Math.hypot(...v);
  if (speed < 1e-3 * flown.gale) return;
  const p = place(track, at), before = s => eye(...p.map((c, a) => c - s * droneSize() * v[a] / speed));
  arrow(g, before(1.8 + 3 * speed / flown.gale), before(1.8), colourOf(track));
}
function ghost(g, track, at) { // where the controller was told that it is
  const colour = colourOf(track), tip = eye(...place(track, at, track.told)), recent = [];
  for (let i = Math.max(0, at - TRAIL / flown.step); i < at; i += 1) recent.push(eye(...place(track, i, track.told)));
  if (!tip) return;
  stroke(g, [...recent, tip], colours.panel, 1.6, 0.7);
  stroke(g, [...recent, tip], colour, 1.6, 1, [1, 4]);
  const ring = Array.from({ length: 25 }, (_, k) => [tip[0] + 6 * Math.cos(k * Math.PI / 12), tip[1] + 6 * Math.sin(k * Math.PI / 12)]);
  for (const [c, width] of [[colours.panel, 5], [colour, 2]]) {
    stroke(g, [eye(...place(track, at)), tip], c, 0.6 * width);
    stroke(g, ring, c, width);
  }
}
function drawScene() { // one picture, or two beside each other with the same camera, clipped at the middle
  const [g, w, h] = surface(scene);
  if (!w) return;
  if (!beside()) return drawView(g, w, h, flown.tracks.filter(t => t.shown));
  const half = w / 2, seen = [+left.value, +right.value].map(i => flown.tracks[i]);
  seen.forEach((track, n) => {
    g.save();
    g.beginPath(); g.rect(n * half, 0, half, h); g.clip();
    g.translate(n * half, 0);
    drawView(g, half, h, [track]);
    g.font = "600 14px system-ui,sans-serif"; g.textAlign = "center"; g.fillStyle = colourOf(track);
    g.fillText(track.label, half / 2, h - 58);
    g.restore();
  });
  stroke(g, [[half, 0], [half, h]], colours.rule, 2);
  const [a, b] = seen.map(t => lerp(t.size, 1, Math.min(time / flown.step, t.samples - 1), t.samples)[0]);
  hint.textContent += `, left ${millimetres(a)} mm, right ${millimetres(b)} mm`;
}
function drawView(g, w, h, seen) {
  const at = time / flown.step;
  camera.centre = camera.view === "chase" ? lerp(flown.path, 3, at, flown.samples) : [0, 1, 2].map(a => (flown.low[a] + flown.high[a]) / 2);
  aim(w, h);
  const [cell, floor] = ground(g), reference = [];
  for (let i = 0; i < flown.samples; i++) reference.push(eye(flown.path[3 * i], flown.path[3 * i + 1], flown.path[3 * i + 2]));
  stroke(g, reference, colours.muted, 1.2, 0.9, [5, 4]);
  for (const track of seen) {
    const end = Math.min(at, track.samples - 1), whole = [], recent = [];
    const step = Math.max(1, Math.floor(track.samples / 700));
    for (let i = 0; i < end; i += step) whole.push(eye(...place(track, i)));
    for (let i = Math.max(0, end - TRAIL / flown.step); i < end; i += 1) recent.push(eye(...place(track, i)));
    const tip = eye(...place(track, end));
    whole.push(tip); recent.push(tip);
    stroke(g, whole, colourOf(track), 1.2, 0.4);
    stroke(g, recent, colourOf(track), 2.4);
  }
  const ordered = seen.map(t => [t, Math.min(at, t.samples - 1)]).sort((a, b) => depth(b) - depth(a));
  for (const [track, i] of ordered) {
    drone(g, track, i, floor);
    if (track.air) wind(g, track, i);
    if (track.told) ghost(g, track, i);
    if (track.samples < flown.samples && at > track.samples - 1) {
      const p = eye(...place(track, track.samples - 1));
      if (p) { g.fillStyle = colourOf(track); g.font = "600 13px system-ui,sans-serif"; g.fillText(`${track.outcome.replace("_", " ")}`, p[0] + 14, p[1] - 10); }
    }
  }
  clock.textContent = `${time.toFixed(2)} s`;
  const blown = seen.find(t => t.air);
  const air = blown && Math.hypot(...lerp(blown.air, 3, Math.min(at, blown.samples - 1), blown.samples));
  hint.textContent = `grid ${cell} m` + (+gain.value > 1 ? `, errors ${gain.value}×` : "") + (blown ? `, wind ${air.toFixed(1)} m/s` : "");
}
const depth = ([track, i]) => (eye(...place(track, i)) || [0, 0, 0, 1e9])[3];

function traceScale(w, h) {
  let low = Infinity, high = 0;
  for (const t of flown.tracks) {
    const sorted = Float32Array.from(t.size).sort();
    low = Math.min(low, sorted[Math.floor(0.05 * sorted.length)] || 1e-3); high = Math.max(high, sorted[sorted.length - 1]);
  }
  low = Math.max(low / 1.5, high * 1e-5, 1e-4); high = Math.max(high * 1.3, low * 10);
  const a = Math.log(low), b = Math.log(high);
  return { low, high,
    x: t => MARGIN.left + t / flown.duration * (w - MARGIN.left - MARGIN.right),
    y: v => h - MARGIN.bottom - (Math.log(Math.max(v, low)) - a) / (b - a) * (h - MARGIN.top - MARGIN.bottom) };
}
function drawTrace() {
  const [g, w, h] = surface(trace);
  if (!w) return;
  const { low, high, x, y } = traceScale(w, h);
  g.font = "11px system-ui,sans-serif"; g.fillStyle = colours.muted; g.textBaseline = "middle";
  const decades = [];
  for (let d = Math.ceil(Math.log10(low)); 10 ** d <= high; d++) decades.push(10 ** d);
  g.textAlign = "right";
  for (const v of decades) { stroke(g, [[MARGIN.left, y(v)], [w - MARGIN.right, y(v)]], colours.rule, 1); g.fillText(`${+v.toPrecision(1)}`, MARGIN.left - 8, y(v)); }
  g.textAlign = "center";
  const every = nice(flown.duration / 8);
  for (let t = 0; t <= flown.duration + 1e-6; t += every) g.fillText(`${+t.toFixed(2)} s`, Math.min(x(t), w - 14), h - 7);
  for (const track of flown.tracks.filter(t => t.shown)) {
    const line = [], bin = Math.max(1, Math.floor(track.samples / (w - 54)));
    for (let i = 0; i < track.samples; i += bin) line.push([x(i * flown.step), y(Math.max(...track.size.subarray(i, i + bin)))]);
    stroke(g, line, colourOf(track), 1.4, 0.9);
  }
  stroke(g, [[x(time), MARGIN.top - 4], [x(time), h - MARGIN.bottom]], colours.ink, 1.2);
  for (const track of flown.tracks.filter(t => t.shown)) {
    const at = Math.min(time / flown.step, track.samples - 1), [v] = lerp(track.size, 1, at, track.samples);
    g.fillStyle = colourOf(track); g.beginPath(); g.arc(x(at * flown.step), y(v), 3.2, 0, 7); g.fill();
  }
}
const millimetres = v => v >= 100 ? v.toFixed(0) : v >= 10 ? v.toFixed(1) : v.toFixed(2);
function drawPilots() {
  for (const track of flown.tracks) {
    const at = Math.min(time / flown.step, track.samples - 1), over = time / flown.step > track.samples - 1 && track.samples < flown.samples;
    track.now.textContent = over ? track.outcome.replace("_", " ") : `${millimetres(lerp(track.size, 1, at, track.samples)[0])} mm`;
    track.now.classList.toggle("gone", over);
    lerp(track.share, flown.rotors.length, at, track.samples).forEach((u, n) => track.bars[n].style.setProperty("--u", u.toFixed(3)));
  }
}
let waiting = false;
function draw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    drawScene(); drawTrace(); drawPilots();
    scrub.value = time;
    scrub.setAttribute("aria-valuetext", `${time.toFixed(1)} of ${flown.duration.toFixed(1)} seconds`);
  });
}

// ---- time ---------------------------------------------------------------------------------------------------------
function seek(t) { time = Math.max(0, Math.min(flown.duration, t)); draw(); }
function play(on) {
  playing = on;
  playButton.textContent = on ? "Pause" : "Play";
  playButton.setAttribute("aria-pressed", String(on));
  cancelAnimationFrame(frame);
  if (!on) return;
  if (time >= flown.duration - 1e-6) time = 0;
  before = performance.now();
  frame = requestAnimationFrame(tick);
}
function tick(now) {
  if (!playing) return;
  seek(time + Math.min(now - before, 250) / 1e3 * +rate.value);
  before = now;
  if (time >= flown.duration) play(false); else frame = requestAnimationFrame(tick);
}
function faster(by) { rate.selectedIndex = Math.max(0, Math.min(rate.options.length - 1, rate.selectedIndex + by)); }

// ---- what is flown ------------------------------------------------------------------------------------------------
const SHAPES = @@SHAPES@@;
function open(index) {
  play(false);
  flown = decode(cases[index]);
  camera.fit = 0;
  chooser.value = index;
  scrub.max = flown.duration; scrub.step = flown.step;
  pilots.replaceChildren(...flown.tracks.map((track, n) => {
    const button = document.createElement("button");
    button.type = "button"; button.className = "pilot"; button.setAttribute("aria-pressed", String(track.shown));
    const name = document.createElement("span"), bars = document.createElement("span"), now = document.createElement("span");
    name.innerHTML = `<svg class="mark${track.filled ? "" : " hollow"}" viewBox="-5 -5 10 10" aria-hidden="true" style="--own:var(--series-${track.colour})"><path d="${SHAPES[track.shape]}"/></svg>`;
    name.append(track.label);
    bars.className = "thrust"; bars.style.color = `var(--series-${track.colour})`; bars.setAttribute("aria-hidden", "true");
    track.bars = flown.rotors.map(() => bars.appendChild(document.createElement("i")));
    now.className = "now"; track.now = now;
    button.append(name, bars, now);
    button.title = track.cause || `show or hide ${track.label} (key ${n + 1})`;
    button.onclick = () => { track.shown = !track.shown; button.setAttribute("aria-pressed", String(track.shown)); draw(); };
    return button;
  }));
  for (const [select, first] of [[left, 0], [right, Math.min(1, flown.tracks.length - 1)]]) {
    select.replaceChildren(...flown.tracks.map((t, n) => new Option(t.label, n)));
    select.value = first;
  }
  both.hidden = flown.tracks.length < 2;
  pair.hidden = !beside();
  slide(index);
  seek(0.42 * flown.duration);
}
// ---- sliders over the speeds of a course, and over the seeds of a speed --------------------------------------------
const sorted = values => [...new Set(values)].sort((a, b) => a - b);
function slide(index) {
  const own = cases[index], course = cases.filter(c => c.course === own.course);
  const set = (slider, name, values, value, unit) => {
    slider.parentElement.hidden = values.length < 2;
    slider.max = values.length - 1; slider.value = values.indexOf(value);
    slider.setAttribute("aria-valuetext", `${value}${unit}`);
    part(name).textContent = `${value}${unit}`;
  };
  set(speeds, "at-speed", sorted(course.map(c => c.speed)), own.speed, " m/s");
  set(seeds, "at-seed", sorted(course.filter(c => c.speed === own.speed).map(c => c.seed)), own.seed, "");
}
function moved(slider) { // the flight that has what the slider says, and of the rest as much as there is
  const own = cases[+chooser.value], course = cases.filter(c => c.course === own.course), at = time / flown.duration;
  const bySeed = slider === seeds, pool = bySeed ? course.filter(c => c.speed === own.speed) : course;
  const value = sorted(pool.map(c => bySeed ? c.seed : c.speed))[+slider.value];
  const found = pool.filter(c => (bySeed ? c.seed : c.speed) === value);
  const next = found.find(c => c.seed === own.seed) || found[0];
  const kept = [left.value, right.value];
  open(cases.indexOf(next));
  if (kept.every(v => +v < flown.tracks.length)) [left.value, right.value] = kept;
  seek(at * flown.duration);
}
speeds.oninput = () => moved(speeds);
seeds.oninput = () => moved(seeds);
both.onclick = () => {
  both.setAttribute("aria-pressed", String(both.getAttribute("aria-pressed") !== "true"));
  pair.hidden = !beside(); camera.fit = 0; draw();
};
left.onchange = right.onchange = draw;
cases.forEach((c, i) => chooser.append(new Option(c.title, i)));
chooser.onchange = () => open(+chooser.value);
playButton.onclick = () => play(!playing);
scrub.oninput = () => { play(false); seek(+scrub.value); };
gain.onchange = draw;
for (const button of document.querySelectorAll("[data-open-case]")) {
  button.onclick = () => {
    open(+button.dataset.openCase);
    document.getElementById("replay").scrollIntoView({ behavior: calm.matches ? "auto" : "smooth" });
    scene.focus({ preventScroll: true });
  };
}

// ---- view ---------------------------------------------------------------------------------------------------------
const views = [...root.querySelectorAll("[data-view]")];
function look(view) {
  camera.view = view; [camera.yaw, camera.pitch] = VIEWS[view]; camera.zoom = 1; camera.fit = 0;
  for (const b of views) b.setAttribute("aria-pressed", String(b.dataset.view === view));
  draw();
}
for (const b of views) b.onclick = () => look(b.dataset.view);
const zoom = by => { camera.zoom = Math.max(0.3, Math.min(12, camera.zoom * by)); draw(); };
function orbit(dx, dy) {
  camera.yaw += dx; camera.pitch = Math.max(-0.2, Math.min(Math.PI / 2 - 1e-3, camera.pitch + dy));
  draw();
}
const touches = new Map();
let spread = 0;
scene.onpointerdown = e => { touches.set(e.pointerId, [e.clientX, e.clientY]); scene.setPointerCapture(e.pointerId); spread = 0; };
scene.onpointerup = scene.onpointercancel = e => { touches.delete(e.pointerId); spread = 0; };
scene.onpointermove = e => {
  const last = touches.get(e.pointerId);
  if (!last) return;
  touches.set(e.pointerId, [e.clientX, e.clientY]);
  orbit((last[0] - e.clientX) * -0.008 / touches.size, (e.clientY - last[1]) * 0.008 / touches.size);
  if (touches.size === 2) {
    const [a, b] = [...touches.values()], d = Math.hypot(a[0] - b[0], a[1] - b[1]);
    if (spread) zoom(d / spread);
    spread = d;
  }
};
scene.addEventListener("wheel", e => {
  if (document.activeElement !== scene && !e.ctrlKey) return; // the page scrolls until the picture is in focus
  e.preventDefault(); zoom(Math.exp(-e.deltaY * 0.0012));
}, { passive: false });
let dragging = false;
const toTime = e => { const box = trace.getBoundingClientRect(); return (e.clientX - box.left - MARGIN.left) / (box.width - MARGIN.left - MARGIN.right) * flown.duration; };
trace.onpointerdown = e => { dragging = true; trace.setPointerCapture(e.pointerId); play(false); seek(toTime(e)); };
trace.onpointermove = e => { if (dragging) seek(toTime(e)); };
trace.onpointerup = trace.onpointercancel = () => { dragging = false; };

root.addEventListener("keydown", e => {
  if (e.altKey || e.ctrlKey || e.metaKey) return;
  const typing = e.target.matches("select, input"), onButton = e.target.matches("button");
  const keys = {
    " ": () => play(!playing),
    ArrowLeft: () => e.shiftKey ? orbit(-0.12, 0) : (play(false), seek(time - 0.1)),
    ArrowRight: () => e.shiftKey ? orbit(0.12, 0) : (play(false), seek(time + 0.1)),
    ArrowUp: () => e.shiftKey ? orbit(0, 0.1) : zoom(1.15),
    ArrowDown: () => e.shiftKey ? orbit(0, -0.1) : zoom(1 / 1.15),
    Home: () => seek(0), End: () => seek(flown.duration), "+": () => faster(1), "=": () => faster(1), "-": () => faster(-1),
  };
  if (typing && e.key !== " " && e.key !== "+" && e.key !== "-") return;
  if (typing && e.target.matches("select")) return;
  if (e.key === " " && onButton) return;
  const digit = /^[1-9]$/.test(e.key) && pilots.children[+e.key - 1];
  if (digit) digit.click();
  else if (keys[e.key]) keys[e.key]();
  else return;
  e.preventDefault();
});

document.addEventListener("themechange", () => { readColours(); draw(); });
new ResizeObserver(draw).observe(root);
readColours();
open(0);
})();
