(() => {
"use strict";
const root = document.querySelector("[data-player]");
const cases = JSON.parse(document.getElementById("replay-data").textContent);
const part = name => root.querySelector(`[data-replay="${name}"]`);
const scene = part("scene"), trace = part("trace"), pilots = part("pilots"), scrub = part("scrub");
const playButton = part("play"), rate = part("rate"), gain = part("gain"), chooser = part("case");
const TRAIL = 2.5, MARGIN = { left: 46, right: 8, top: 8, bottom: 18 }; // s; pixels
const INK = "#17191d", MUTED = "#5a616c", RULE = "#e3e3de", PANEL = "#ffffff";

// ---- data ---------------------------------------------------------------------------------------------------------
const shorts = (text, scale) => {
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  return Float32Array.from(new Int16Array(bytes.buffer), v => v * scale);
};
const vector = (array, i) => array.subarray(3 * i, 3 * i + 3);
function decode(packed) {
  if (packed.path) return packed;
  packed.path = shorts(packed.reference, packed.reference_step);
  for (const track of packed.tracks) {
    track.offset = shorts(track.error, track.error_step);
    track.quaternion = shorts(track.attitude, 1 / 32767);
    track.size = Float32Array.from({ length: track.samples }, (_, i) => 1e3 * Math.hypot(...vector(track.offset, i)));
    track.shown = true;
  }
  packed.low = [Infinity, Infinity, Infinity]; packed.high = [-Infinity, -Infinity, -Infinity];
  packed.path.forEach((v, i) => {
    packed.low[i % 3] = Math.min(packed.low[i % 3], v);
    packed.high[i % 3] = Math.max(packed.high[i % 3], v);
  });
  packed.centre = packed.low.map((low, a) => (low + packed.high[a]) / 2);
  packed.radius = Math.max(0.5, Math.hypot(...packed.low.map((low, a) => packed.high[a] - low)) / 2);
  packed.arm = Math.max(...packed.rotors.map(r => Math.hypot(...r)));
  packed.grown = Math.max(1, 0.09 * packed.radius / packed.arm); // how much larger a vehicle is drawn than it is
  packed.duration = (packed.samples - 1) * packed.step;
  return packed;
}
function between(array, width, at, n) { // the values at a sample that need not be whole
  const i = Math.min(Math.floor(at), n - 1), j = Math.min(i + 1, n - 1), share = Math.min(at - i, 1);
  return Array.from({ length: width }, (_, a) => array[width * i + a] * (1 - share) + array[width * j + a] * share);
}

// ---- geometry -----------------------------------------------------------------------------------------------------
let flown, time = 0, playing = false, before = 0, eye;
const camera = { yaw: -0.7, pitch: 0.5, zoom: 1 };
function aim(width, height) { // eye: a point of the world -> [x, y, depth] in the picture, null behind the camera
  const cy = Math.cos(camera.yaw), sy = Math.sin(camera.yaw), cp = Math.cos(camera.pitch), sp = Math.sin(camera.pitch);
  const scale = 2.6 * camera.zoom * Math.min(0.45 * width, 0.62 * height) / flown.radius;
  eye = (x, y, z) => {
    x -= flown.centre[0]; y -= flown.centre[1]; z -= flown.centre[2];
    const right = cy * x - sy * y, away = sy * x + cy * y, depth = away * cp - z * sp, up = away * sp + z * cp;
    const far = 2.6 + depth / flown.radius;
    return far < 0.15 ? null : [width / 2 + right * scale / far, height * 0.42 - up * scale / far, depth];
  };
}
const turn = ([w, x, y, z], [a, b, c]) => { // a vector of the body in the world
  const tx = 2 * (y * c - z * b), ty = 2 * (z * a - x * c), tz = 2 * (x * b - y * a);
  return [a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx];
};
const sampleOf = track => Math.min(time / flown.step, track.samples - 1);
function place(track, at) {
  const error = between(track.offset, 3, at, track.samples);
  return between(flown.path, 3, at, flown.samples).map((v, a) => v + gain.value * error[a]);
}

// ---- drawing ------------------------------------------------------------------------------------------------------
function surface(canvas) {
  const ratio = Math.min(devicePixelRatio || 1, 2), w = canvas.clientWidth, h = canvas.clientHeight;
  canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.lineJoin = g.lineCap = "round";
  return [g, w, h];
}
function stroke(g, points, colour, width, alpha = 1, dash = []) { // a point that is null breaks the line
  g.strokeStyle = colour; g.lineWidth = width; g.globalAlpha = alpha; g.setLineDash(dash);
  g.beginPath();
  points.forEach((p, i) => p && (points[i - 1] ? g.lineTo(p[0], p[1]) : g.moveTo(p[0], p[1])));
  g.stroke(); g.setLineDash([]); g.globalAlpha = 1;
}
const nice = v => [1, 2, 5, 10].map(s => s * 10 ** Math.floor(Math.log10(v))).find(s => s >= v);
function ground(g, floor) { // returns the width of a cell (m)
  const cell = nice(flown.radius / 5), n = 9, [cx, cy] = flown.centre.map(v => Math.round(v / cell) * cell);
  const every = Array.from({ length: 2 * n + 1 }, (_, k) => (k - n) * cell);
  for (const i of every) {
    const alpha = 1 - 0.75 * Math.abs(i) / (n * cell);
    stroke(g, every.map(j => eye(cx + i, cy + j, floor)), RULE, 1, alpha);
    stroke(g, every.map(j => eye(cx + j, cy + i, floor)), RULE, 1, alpha);
  }
  const samples = Array.from({ length: flown.samples }, (_, i) => vector(flown.path, i));
  stroke(g, samples.map(([x, y]) => eye(x, y, floor)), MUTED, 2, 0.18);
  stroke(g, samples.map(p => eye(...p)), MUTED, 1.2, 0.9, [5, 4]);
  return cell;
}
function trail(g, track) {
  const end = sampleOf(track), tip = eye(...place(track, end)), points = [], step = Math.max(1, Math.floor(end / 700));
  for (let i = 0; i < end; i += step) points.push(eye(...place(track, i)));
  stroke(g, [...points, tip], track.colour, 1.2, 0.4);
  stroke(g, [...points.slice(-Math.ceil(TRAIL / flown.step / step)), tip], track.colour, 2.4);
}
function drone(g, track, floor) {
  const at = sampleOf(track), p = place(track, at), q = between(track.quaternion, 4, at, track.samples);
  const world = v => eye(...turn(q, v.map(c => c * flown.grown)).map((c, a) => c + p[a]));
  const middle = eye(...p), size = 0.5 * flown.arm;
  if (!middle) return;
  stroke(g, [middle, eye(p[0], p[1], floor)], track.colour, 1, 0.35, [2, 3]);
  for (const [x, y, z] of flown.rotors) {
    const circle = Array.from({ length: 21 }, (_, k) => k * Math.PI / 10);
    const disc = circle.map(a => world([x + size * Math.cos(a), y + size * Math.sin(a), z]));
    stroke(g, [middle, world([x, y, z])], track.colour, 2.4);
    stroke(g, disc, PANEL, 4, 0.55);
    stroke(g, disc, track.colour, 1.5);
  }
  stroke(g, [middle, world([1.25 * flown.arm, 0, 0])], INK, 1.5, 0.8);
  if (hasEnded(track)) {
    g.fillStyle = track.colour; g.font = "600 13px system-ui,sans-serif";
    g.fillText(track.outcome.replace("_", " "), middle[0] + 14, middle[1] - 10);
  }
}
const hasEnded = track => track.samples < flown.samples && time / flown.step > track.samples - 1;
const depth = track => (eye(...place(track, sampleOf(track))) || [0, 0, 1e9])[2];
function drawScene() {
  const [g, w, h] = surface(scene), seen = flown.tracks.filter(t => t.shown);
  aim(w, h);
  const floor = flown.low[2] - Math.max(0.06 * flown.radius, 0.35 * flown.grown * flown.arm), cell = ground(g, floor);
  for (const track of seen) trail(g, track);
  for (const track of seen.sort((a, b) => depth(b) - depth(a))) drone(g, track, floor);
  part("time").textContent = `${time.toFixed(2)} s`;
  part("hint").textContent = `grid ${cell} m` + (gain.value > 1 ? `, errors ${gain.value}×` : "");
}
function drawTrace() {
  const [g, w, h] = surface(trace), sizes = flown.tracks.map(t => Float32Array.from(t.size).sort());
  const most = Math.max(...sizes.map(s => s[s.length - 1]));
  const least = Math.min(...sizes.map(s => s[Math.floor(0.05 * s.length)] || 1e-3));
  const low = Math.max(least / 1.5, most * 1e-5, 1e-4), high = Math.max(most * 1.3, low * 10);
  const x = t => MARGIN.left + t / flown.duration * (w - MARGIN.left - MARGIN.right);
  const share = v => Math.log(Math.max(v, low) / low) / Math.log(high / low);
  const y = v => h - MARGIN.bottom - share(v) * (h - MARGIN.top - MARGIN.bottom);
  g.font = "11px system-ui,sans-serif"; g.fillStyle = MUTED; g.textBaseline = "middle"; g.textAlign = "right";
  for (let d = Math.ceil(Math.log10(low)); 10 ** d <= high; d++) {
    stroke(g, [[MARGIN.left, y(10 ** d)], [w - MARGIN.right, y(10 ** d)]], RULE, 1);
    g.fillText(`${+(10 ** d).toPrecision(1)}`, MARGIN.left - 8, y(10 ** d));
  }
  g.textAlign = "center";
  for (let t = 0; t <= flown.duration + 1e-6; t += nice(flown.duration / 8)) {
    g.fillText(`${+t.toFixed(2)} s`, Math.min(x(t), w - 14), h - 7);
  }
  stroke(g, [[x(time), MARGIN.top - 4], [x(time), h - MARGIN.bottom]], INK, 1.2);
  for (const track of flown.tracks.filter(t => t.shown)) {
    const line = [], bin = Math.max(1, Math.floor(track.samples / w)), at = sampleOf(track);
    for (let i = 0; i < track.samples; i += bin) {
      line.push([x(i * flown.step), y(Math.max(...track.size.subarray(i, i + bin)))]);
    }
    stroke(g, line, track.colour, 1.4, 0.9);
    stroke(g, Array(2).fill([x(at * flown.step), y(between(track.size, 1, at, track.samples)[0])]), track.colour, 6.4);
  }
}
function draw() {
  requestAnimationFrame(() => {
    drawScene(); drawTrace();
    for (const track of flown.tracks) {
      const [v] = between(track.size, 1, sampleOf(track), track.samples), digits = v >= 100 ? 0 : v >= 10 ? 1 : 2;
      track.now.textContent = hasEnded(track) ? track.outcome.replace("_", " ") : `${v.toFixed(digits)} mm`;
      track.now.classList.toggle("gone", hasEnded(track));
    }
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
  if (!on) return;
  if (time >= flown.duration - 1e-6) time = 0;
  before = performance.now();
  requestAnimationFrame(tick);
}
function tick(now) {
  if (!playing) return;
  seek(time + Math.max(0, Math.min(now - before, 250)) / 1e3 * rate.value);
  before = now;
  if (time >= flown.duration) play(false); else requestAnimationFrame(tick);
}

// ---- what is flown ------------------------------------------------------------------------------------------------
function open(index) {
  play(false);
  flown = decode(cases[index]);
  chooser.value = index;
  scrub.max = flown.duration; scrub.step = flown.step;
  pilots.replaceChildren(...flown.tracks.map(track => {
    const [button, mark, name, now] = ["button", "b", "span", "span"].map(tag => document.createElement(tag));
    Object.assign(button, { type: "button", className: "pilot", title: track.cause || `show or hide ${track.label}` });
    Object.assign(mark, { className: "mark", textContent: track.glyph, style: `color:${track.colour}` });
    name.append(mark, track.label);
    now.className = "now";
    track.now = now;
    button.append(name, now);
    const show = shown => {
      track.shown = shown;
      button.setAttribute("aria-pressed", String(shown));
    };
    button.onclick = () => { show(!track.shown); draw(); };
    show(track.shown);
    return button;
  }));
  seek(0.42 * flown.duration);
}
cases.forEach((c, i) => chooser.append(new Option(c.title, i)));
chooser.onchange = () => open(+chooser.value);
playButton.onclick = () => play(!playing);
scrub.oninput = () => { play(false); seek(+scrub.value); };
gain.onchange = draw;
for (const button of document.querySelectorAll("[data-replay-of]")) {
  button.onclick = () => {
    open(+button.dataset.replayOf);
    document.getElementById("replay").scrollIntoView();
    scene.focus({ preventScroll: true });
  };
}

// ---- view ---------------------------------------------------------------------------------------------------------
function orbit(dx, dy) {
  camera.yaw += dx; camera.pitch = Math.max(-0.2, Math.min(Math.PI / 2 - 1e-3, camera.pitch + dy));
  draw();
}
function drag(canvas, begin, move) {
  let last = null;
  canvas.onpointerdown = e => { last = e; canvas.setPointerCapture(e.pointerId); begin(e); };
  canvas.onpointermove = e => { if (last) { move(e, last); last = e; } };
  canvas.onpointerup = canvas.onpointercancel = () => { last = null; };
}
drag(scene, () => {}, (e, last) => orbit((e.clientX - last.clientX) * 0.008, (e.clientY - last.clientY) * 0.008));
const toTime = e => {
  const box = trace.getBoundingClientRect();
  seek((e.clientX - box.left - MARGIN.left) / (box.width - MARGIN.left - MARGIN.right) * flown.duration);
};
drag(trace, e => { play(false); toTime(e); }, toTime);
scene.addEventListener("wheel", e => {
  if (document.activeElement !== scene && !e.ctrlKey) return; // the page scrolls until the picture is in focus
  e.preventDefault();
  camera.zoom = Math.max(0.3, Math.min(12, camera.zoom * Math.exp(-e.deltaY * 0.0012)));
  draw();
}, { passive: false });
scene.addEventListener("keydown", e => {
  const step = by => { play(false); seek(time + by); };
  const keys = e.shiftKey ? {
    ArrowLeft: () => orbit(-0.12, 0), ArrowRight: () => orbit(0.12, 0),
    ArrowUp: () => orbit(0, 0.1), ArrowDown: () => orbit(0, -0.1),
  } : {
    " ": () => play(!playing), ArrowLeft: () => step(-0.1), ArrowRight: () => step(0.1),
    Home: () => seek(0), End: () => seek(flown.duration),
  };
  if (e.altKey || e.ctrlKey || e.metaKey || !keys[e.key]) return;
  e.preventDefault();
  keys[e.key]();
});
new ResizeObserver(draw).observe(root);
open(0);
})();
