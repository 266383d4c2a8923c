"use strict";
// The page around the worlds: panes, controls, dragging, a strip chart. PAGE is what `live_page` writes.
const live = { ready: false, states: null, failed: null };  // what tests look at
(() => {
const byId = (id) => document.getElementById(id);
const THREE = MeshCat.THREE, dark = matchMedia("(prefers-color-scheme: dark)");
document.querySelector("h1").textContent = PAGE.title;
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const floats = (text) => text === null ? null : new Float32Array(bytes(text).buffer);
const layers = (packed) => packed.map((l) => ({ ...l, w: floats(l.w), b: floats(l.b) }));
function policyOf(choice) {
  const { planner, low } = PAGE.policies[choice.method].kept[choice.kept].policies[choice.seed];
  return { planner: layers(planner), low: low.kind === "networks"
    ? { kind: low.kind, networks: low.networks.map(layers) }
    : { kind: low.kind, gain: low.gain && floats(low.gain) } };
}

// ---- panes: one meshcat viewer for each arm ------------------------------------------------------
const arms = PAGE.arms.map((choice, index) => {
  const arm = { choice: { ...choice }, index, color: PAGE.policies[choice.method].color, trace: [] };
  arm.box = document.createElement("section");
  arm.box.className = "arm";
  arm.box.innerHTML = '<header><select aria-label="method"></select><select aria-label="seed"></select>' +
    '<select aria-label="checkpoint"></select><span class="numbers"></span></header><div class="pane" tabindex="0"></div>';
  byId("arms").appendChild(arm.box);
  arm.pane = arm.box.querySelector(".pane");
  arm.pane.setAttribute("aria-label", "scene " + (index + 1));
  arm.numbers = arm.box.querySelector(".numbers");
  arm.selects = arm.box.querySelectorAll("select");
  return arm;
});
live.traces = arms.map((arm) => arm.trace);
function fill(select, options, chosen) {
  select.replaceChildren(...options.map((text, k) => new Option(text, k, false, k === chosen)));
}
function showChoice(arm) {
  const { method, kept, seed } = arm.choice, policy = PAGE.policies[method];
  fill(arm.selects[0], PAGE.policies.map((p) => p.title), method);
  fill(arm.selects[1], policy.kept[kept].seeds.map((s) => "seed " + s), seed);
  fill(arm.selects[2], policy.kept.map((k) => k.step.toLocaleString("en") + " steps"), kept);
  arm.color = policy.color;
  arm.box.style.setProperty("--color", arm.color);
}
function makeViewer(arm) {
  const viewer = arm.viewer = new MeshCat.Viewer(arm.pane);
  const fit = viewer.set_3d_pane_size.bind(viewer);
  viewer.set_3d_pane_size = () => fit(arm.pane.clientWidth, arm.pane.clientHeight);
  new ResizeObserver(() => viewer.set_3d_pane_size()).observe(arm.pane);
  for (const command of PAGE.commands) viewer.handle_command_bytearray(bytes(command));
  arm.bodies = PAGE.bodies.map(({ path, id }) => ({
    id, object: viewer.scene_tree.find(["meshcat", path]).object }));
  for (const name of ["Grid", "Axes"]) viewer.set_property([name], "visible", false);
  arm.ball = new THREE.Mesh(new THREE.SphereGeometry(PAGE.ball, 24, 16),
    new THREE.MeshLambertMaterial({ color: 0x009E73, emissive: 0x009E73, emissiveIntensity: 0.4 }));
  arm.goal = new THREE.Mesh(new THREE.SphereGeometry(PAGE.ball * 0.7, 24, 16),
    new THREE.MeshLambertMaterial({ color: 0xD55E00, emissive: 0xD55E00, emissiveIntensity: 0.4 }));
  arm.arrow = new THREE.ArrowHelper(new THREE.Vector3(1, 0, 0), new THREE.Vector3(), 0.03, 0xCC79A7);
  arm.arrow.visible = false;
  viewer.scene.add(arm.ball, arm.goal, arm.arrow);
  paintBackground(viewer);
  viewer.set_3d_pane_size();
  home(arm);
  let busy = false;  // both cameras move together
  viewer.controls.addEventListener("change", () => {
    if (busy) return;
    for (const other of arms) {
      if (other === arm || !other.viewer) continue;
      busy = true;
      other.viewer.camera.position.copy(viewer.camera.position);
      other.viewer.controls.target.copy(viewer.controls.target);
      other.viewer.controls.update();
      busy = false;
    }
  });
  viewer.camera.near = 0.005;
  viewer.camera.fov = 40;
  viewer.camera.updateProjectionMatrix();
  makeDraggable(arm);
}
function paintBackground(viewer) {
  const [top, bottom] = dark.matches ? [[0.10, 0.12, 0.15], [0.05, 0.06, 0.08]] : [[0.97, 0.98, 0.99], [0.87, 0.90, 0.93]];
  viewer.set_property(["Background"], "top_color", top);
  viewer.set_property(["Background"], "bottom_color", bottom);
}
dark.addEventListener("change", () => arms.forEach((arm) => paintBackground(arm.viewer)));
const upright = (p) => new THREE.Vector3(p[0], p[2], -p[1]);  // cameras have y up, the scene z
function home(arm) {
  arm.viewer.camera.position.copy(upright(PAGE.camera.position));
  arm.viewer.controls.target.copy(upright(PAGE.camera.target));
  arm.viewer.controls.update();
}

// ---- dragging the sub-goal in the plane that faces the camera -------------------------------------
function makeDraggable(arm) {
  const { viewer } = arm, canvas = viewer.renderer.domElement, ray = new THREE.Raycaster();
  const plane = new THREE.Plane(), hit = new THREE.Vector3();
  let dragging = false;
  function cast(event) {
    const box = canvas.getBoundingClientRect();
    const at = new THREE.Vector2(2 * (event.clientX - box.left) / box.width - 1,
      1 - 2 * (event.clientY - box.top) / box.height);
    ray.setFromCamera(at, viewer.camera);
  }
  canvas.addEventListener("pointerdown", (event) => {
    cast(event);
    const center = arm.ball.getWorldPosition(new THREE.Vector3());
    const reach = viewer.camera.position.distanceTo(center) * 0.04;  // easy to catch from afar
    if (ray.ray.distanceToPoint(center) > Math.max(reach, PAGE.ball)) return;
    dragging = true;
    viewer.controls.enabled = false;
    canvas.setPointerCapture(event.pointerId);
    plane.setFromNormalAndCoplanarPoint(viewer.camera.getWorldDirection(new THREE.Vector3()), center);
    setPlanning(false);
    event.stopPropagation();
  }, true);
  canvas.addEventListener("pointermove", (event) => {
    if (!dragging) return;
    cast(event);
    if (ray.ray.intersectPlane(plane, hit)) tell({ kind: "target", position: [hit.x, -hit.z, hit.y] });
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => {
    dragging = false;
    viewer.controls.enabled = true;
  });
}

// ---- the worlds: in a worker, or on this thread where a worker is not allowed ---------------------
let port;
const tell = (message) => port.postMessage(message);
function connect() {
  const source = byId("engine").textContent;
  try {
    const file = URL.createObjectURL(new Blob([source, "\nserve(self, loadMujoco);"], { type: "text/javascript" }));
    port = new Worker(file);
    port.onerror = (event) => { event.preventDefault(); if (!live.ready) connectHere(source); };
    live.thread = "worker";
  } catch (error) {
    connectHere(source);
  }
}
function connectHere(source) {
  const channel = new MessageChannel(), script = document.createElement("script");
  script.textContent = source;
  document.head.appendChild(script);
  port = channel.port2;
  live.thread = "page";
  serve(channel.port1, loadMujoco);
  begin();
}
async function begin() {
  port.onmessage = ({ data }) => hear[data.kind](data);
  const packed = new Blob([bytes(byId("wasm").textContent)]).stream();
  const wasm = await new Response(packed.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  tell({ kind: "init", wasm, task: PAGE.task, policies: arms.map((arm) => policyOf(arm.choice)) });
}
const hear = {
  ready() {
    live.ready = true;
    byId("note").remove();
    arms.forEach(makeViewer);
    setPlanning(PAGE.plan);
    if (!PAGE.plan) tell({ kind: "target", position: PAGE.target });
    tell({ kind: "run", on: true });
  },
  state({ arms: states }) {
    live.states = states;
    states.forEach((state, k) => {
      const error = Math.hypot(...state.tip.map((x, i) => x - state.target[i]));
      arms[k].trace.push([state.time, 1e3 * error]);
      if (arms[k].trace.length > 1 && state.time < arms[k].trace.at(-2)[0]) arms[k].trace.length = 0;
      while (arms[k].trace.length && state.time - arms[k].trace[0][0] > 10) arms[k].trace.shift();
    });
  },
  replayed(answer) { live.replayed = answer; },
  failed({ text }) {
    live.failed = text;
    const note = byId("note") || document.body.appendChild(Object.assign(document.createElement("div"), { id: "note" }));
    note.textContent = "The simulation stopped: " + text;
  },
};

// ---- controls ----------------------------------------------------------------------------------------
let planning = PAGE.plan, running = true;
function setPlanning(on) {
  planning = on;
  byId("plan").setAttribute("aria-pressed", String(on));
  byId("plan").textContent = on ? "planner sets the sub-goals" : "you set the sub-goal";
  tell({ kind: "plan", on });
}
function setRunning(on) {
  running = on;
  byId("run").setAttribute("aria-pressed", String(on));
  byId("run").textContent = on ? "running" : "paused";
  tell({ kind: "run", on });
}
byId("run").onclick = () => setRunning(!running);
byId("plan").onclick = () => setPlanning(!planning);
byId("restart").onclick = () => tell({ kind: "restart", start: Number(byId("start").value) });
byId("start").onchange = byId("restart").onclick;
byId("home").onclick = () => arms.forEach(home);
fill(byId("start"), PAGE.task.starts.map((_, k) => String(k)), 0);
const PUSHES = { "+x": [5, 0, 0], "−x": [-5, 0, 0], "+y": [0, 5, 0], "−y": [0, -5, 0], "+z": [0, 0, 5], "−z": [0, 0, -5] };
byId("pushes").replaceChildren(...Object.entries(PUSHES).map(([name, force]) => {
  const button = document.createElement("button");
  button.textContent = name;
  button.setAttribute("aria-label", "push 5 newtons along " + name.replace("−", "minus "));
  button.onclick = () => tell({ kind: "push", force, seconds: 0.2 });
  return button;
}));
const KEYS = { ArrowRight: "+x", ArrowLeft: "−x", ArrowUp: "+y", ArrowDown: "−y", PageUp: "+z", PageDown: "−z" };
addEventListener("keydown", (event) => {
  if (event.target.matches("select, button")) return;
  if (event.key === " ") { event.preventDefault(); setRunning(!running); }
  if (!(event.key in KEYS)) return;
  event.preventDefault();
  if (!event.repeat) tell({ kind: "push", force: PUSHES[KEYS[event.key]] });
});
addEventListener("keyup", (event) => { if (event.key in KEYS) tell({ kind: "push", force: [0, 0, 0] }); });
arms.forEach((arm) => {
  showChoice(arm);
  ["method", "seed", "kept"].forEach((name, k) => {
    arm.selects[k].onchange = () => {
      arm.choice[name] = Number(arm.selects[k].value);
      const policy = PAGE.policies[arm.choice.method];
      arm.choice.kept = name === "method" ? policy.kept.length - 1 : Math.min(arm.choice.kept, policy.kept.length - 1);
      arm.choice.seed = Math.min(arm.choice.seed, policy.kept[arm.choice.kept].seeds.length - 1);
      showChoice(arm);
      tell({ kind: "policy", arm: arm.index, policy: policyOf(arm.choice) });
    };
  });
});
live.replay = (choice, start, ticks, more) => tell({ kind: "replay", policy: policyOf(choice), start, ticks, ...more });

// ---- drawing: poses when the browser draws, physics by the clock --------------------------------------
function paint() {
  requestAnimationFrame(paint);
  if (!live.states || !arms[0].viewer) return;
  arms.forEach((arm, k) => {
    const state = live.states[k];
    for (const { id, object } of arm.bodies) {
      object.matrixAutoUpdate = true;
      object.position.set(...state.xpos.slice(3 * id, 3 * id + 3));
      object.quaternion.set(...state.xquat.slice(4 * id + 1, 4 * id + 4), state.xquat[4 * id]);
    }
    arm.ball.position.set(...state.target);
    arm.goal.position.set(...state.goal);
    const push = Math.hypot(...state.pushed);
    arm.arrow.visible = push > 0;
    if (push > 0) {
      arm.arrow.position.set(...state.tip);
      arm.arrow.setDirection(new THREE.Vector3(...state.pushed).normalize());
    }
    const error = arm.trace.length ? arm.trace.at(-1)[1] : 0;
    const far = 1e3 * Math.hypot(...state.tip.map((x, i) => x - state.goal[i]));
    arm.numbers.textContent = `to sub-goal ${error.toFixed(2)} mm · to goal ${far.toFixed(1)} mm · contact ${state.force.toFixed(2)} N`;
    arm.viewer.set_dirty();
  });
  byId("chart-text").textContent = "Distance from tip to sub-goal (mm) over the last 10 s" +
    (arms.length > 1 ? "; solid: left, dashed: right." : ".");
  byId("clock").textContent = live.states[0].time.toFixed(1) + " s";
  drawChart();
}
function drawChart() {
  const canvas = byId("chart"), scale = devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * scale)) { canvas.width = Math.round(w * scale); canvas.height = Math.round(h * scale); }
  const pen = canvas.getContext("2d"), style = getComputedStyle(document.body);
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, w, h);
  const top = Math.max(1, ...arms.flatMap((arm) => arm.trace.map((row) => row[1])));
  const now = live.states[0].time, left = 44, base = h - 16;
  const x = (t) => left + (w - left - 8) * (1 - (now - t) / 10), y = (v) => base - (base - 6) * v / top;
  pen.strokeStyle = pen.fillStyle = style.getPropertyValue("--soft");
  pen.font = "11px system-ui";
  pen.textAlign = "right";
  for (const v of [0, top / 2, top]) {
    pen.fillText(v.toFixed(top < 3 ? 2 : 0), left - 6, y(v) + 4);
    pen.globalAlpha = 0.35;
    pen.beginPath(); pen.moveTo(left, y(v)); pen.lineTo(w - 8, y(v)); pen.stroke();
    pen.globalAlpha = 1;
  }
  pen.fillText("mm", left - 6, h - 2);
  pen.fillText("now", w - 8, h - 2);
  arms.forEach((arm, k) => {
    pen.strokeStyle = dark.matches ? `color-mix(in srgb, ${arm.color} 55%, white)` : arm.color;
    pen.lineWidth = 2;
    pen.setLineDash(k ? [6, 3] : []);
    pen.beginPath();
    arm.trace.forEach(([t, v], i) => i ? pen.lineTo(x(t), y(v)) : pen.moveTo(x(t), y(v)));
    pen.stroke();
  });
  pen.setLineDash([]);
}
try {
  document.createElement("canvas").getContext("webgl2") || (() => { throw new Error("no WebGL"); })();
  connect();
  begin();
  requestAnimationFrame(paint);
} catch (error) {
  byId("note").textContent = "This page needs WebGL, which this browser does not offer: " + error.message;
}
})();
