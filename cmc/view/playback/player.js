"use strict";
// Plays SCENE, which page.py writes: meshcat commands that draw it, packed poses that move it.
(() => {
const byId = (id) => document.getElementById(id);
let viewer;
try {
  viewer = new MeshCat.Viewer(byId("pane"));
} catch (error) {
  const note = document.createElement("p");
  note.id = "failure";
  note.textContent = "This page needs WebGL, which this browser does not offer: " + error.message;
  document.body.appendChild(note);
  return;
}
const THREE = MeshCat.THREE;
const resize = viewer.set_3d_pane_size.bind(viewer);
viewer.set_3d_pane_size = (width, height) => resize(  // the bar below must not hide the scene
  width, height === undefined ? window.innerHeight - byId("bar").offsetHeight : height);

function unpack(text, Type) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return Type ? new Type(bytes.buffer) : bytes;
}
const tint = (number) => "#" + number.toString(16).padStart(6, "0");

// ---- scene -----------------------------------------------------------------------------------
for (const command of SCENE.commands) viewer.handle_command_bytearray(unpack(command));
const times = unpack(SCENE.times, Float64Array);
const last = times.length - 1, start = times[0], duration = times[last] - start;
const moving = {
  objects: SCENE.bodies.map((name) => viewer.scene_tree.find(["meshcat", name]).object),
  poses: unpack(SCENE.poses, Float32Array),
};
const values = SCENE.readouts.map((r) => unpack(r.values, Float64Array));

viewer.set_property(["Background"], "top_color", [0.97, 0.98, 0.99]);
viewer.set_property(["Background"], "bottom_color", [0.87, 0.90, 0.93]);
for (const name of ["Grid", "Axes"]) viewer.set_property([name], "visible", false);
for (const name of ["PointLightNegativeX", "PointLightPositiveX", "FillLight", "AmbientLight"]) {
  viewer.set_property(["Lights", name], "visible", false);
}
const sky = new THREE.HemisphereLight(0xffffff, 0xb4bcc4, 0.62);
sky.position.set(0, 0, 1);
const sun = new THREE.DirectionalLight(0xffffff, 0.4);
sun.castShadow = true;
sun.shadow.mapSize.set(2048, 2048);
const fill = new THREE.DirectionalLight(0xffffff, 0.1);
viewer.scene.add(sky, sun, sun.target, fill);
viewer.scene.fog = new THREE.Fog(0xebeef2, 1, 10);  // an endless floor fades into the background

// The shadow map covers what the camera sees, so that millimetres and metres both get sharp edges.
function aimLights() {
  const t = viewer.controls.target, reach = viewer.camera.position.distanceTo(t);
  const eye = viewer.camera.position;
  const target = new THREE.Vector3(t.x, -t.z, t.y);
  const offset = new THREE.Vector3(eye.x - t.x, -(eye.z - t.z), eye.y - t.y).normalize();
  sun.target.position.copy(target);
  // From near the sun stands low, or the hand above the task would put it in the shade.
  const height = 0.6 + 1.3 * Math.min(Math.max((reach - 0.3) / 0.9, 0), 1);
  sun.position.set(0.35, -1.15, height).add(target);
  fill.position.copy(target).add(offset);
  fill.target = sun.target;
  const box = sun.shadow.camera, half = reach * 0.8;
  box.left = box.bottom = -half;
  box.right = box.top = half;
  box.near = 0.05;
  box.far = 2.2 + 2 * half + 2;
  sun.shadow.bias = -0.0002;
  sun.shadow.normalBias = half * 0.0015;
  box.updateProjectionMatrix();
}

// ---- camera: presets are in the model's coordinates (z up), three.js has y up ------------------
const upright = (p) => new THREE.Vector3(p[0], p[2], -p[1]);
let following = null;
function look(index) {
  const preset = SCENE.cameras[index];
  if (!preset) return;
  viewer.camera.position.copy(upright(preset.position));
  viewer.controls.target.copy(upright(preset.target));
  following = trails.find((trail) => trail.name === preset.follow) || null;
  if (following) following.seen = following.at(0);
  byId("cameras").querySelectorAll("button").forEach(
    (b, i) => b.setAttribute("aria-pressed", String(i === index)));
  seek(now);
  viewer.controls.update();
}
function followTrail(frame, share) {
  const place = following.at(frame, share), step = place.clone().sub(following.seen);
  const shift = new THREE.Vector3(step.x, step.z, -step.y);
  viewer.camera.position.add(shift);
  viewer.controls.target.add(shift);
  following.seen = place;
}
function fitDepth() {
  const reach = viewer.camera.position.distanceTo(viewer.controls.target);
  viewer.camera.near = reach * 0.02;
  viewer.camera.far = reach * 30 + 20;
  viewer.scene.fog.near = 3 + reach * 2;
  viewer.scene.fog.far = 6 + reach * 6;
  viewer.camera.updateProjectionMatrix();
  aimLights();
}
viewer.camera.fov = SCENE.field_of_view;
viewer.controls.addEventListener("change", fitDepth);

// ---- overlays --------------------------------------------------------------------------------
function rowReader(text) {
  const rows = unpack(text, Float32Array);
  return (frame, share = 0) => {
    const i = 3 * frame, j = 3 * Math.min(frame + 1, last);
    const a = new THREE.Vector3(rows[i], rows[i + 1], rows[i + 2]);
    return share > 0 ? a.lerp(new THREE.Vector3(rows[j], rows[j + 1], rows[j + 2]), share) : a;
  };
}
function plain(color, opacity) {
  return new THREE.MeshLambertMaterial(
    { color, opacity, transparent: opacity < 1, emissive: color, emissiveIntensity: 0.35 });
}
function named(object, name) {
  object.name = "overlay " + name;
  viewer.scene.add(object);
  return object;
}

// A trail is a thin tube (seen from near) and a line (seen from far), both cut at the current time.
function makeTrail(item) {
  const at = rowReader(item.points), sides = 6, points = [], corners = [], index = [];
  for (let k = 0; k <= last; k++) points.push(at(k));
  const axis = new THREE.Vector3(), across = new THREE.Vector3(), over = new THREE.Vector3();
  for (let k = 0; k < last; k++) {
    axis.subVectors(points[k + 1], points[k]);
    across.set(axis.z, axis.x, axis.y).cross(axis).normalize();
    over.crossVectors(axis, across).normalize();
    for (const end of [points[k], points[k + 1]]) {
      for (let s = 0; s < sides; s++) {
        const c = item.radius * Math.cos(2 * Math.PI * s / sides);
        const d = item.radius * Math.sin(2 * Math.PI * s / sides);
        corners.push(end.x + c * across.x + d * over.x, end.y + c * across.y + d * over.y,
          end.z + c * across.z + d * over.z);
      }
    }
    for (let s = 0; s < sides; s++) {
      const a = 2 * sides * k + s, b = 2 * sides * k + (s + 1) % sides;
      index.push(a, b, a + sides, b, b + sides, a + sides);
    }
  }
  const tube = new THREE.BufferGeometry();
  tube.setAttribute("position", new THREE.Float32BufferAttribute(corners, 3));
  tube.setIndex(index);
  tube.computeVertexNormals();
  const line = new THREE.BufferGeometry().setFromPoints(points);
  const group = named(new THREE.Group(), item.name);
  const skin = new THREE.MeshBasicMaterial({ color: item.color, side: THREE.DoubleSide });
  group.add(new THREE.Mesh(tube, skin));
  group.add(new THREE.Line(line, new THREE.LineBasicMaterial({ color: item.color })));
  group.traverse((part) => { part.frustumCulled = false; });
  return { name: item.name, at, seen: at(0), update(frame) {
    tube.setDrawRange(0, 6 * sides * frame);
    line.setDrawRange(0, frame + 1);
  } };
}
function makeMarker(item) {
  const at = rowReader(item.points);
  const ball = named(new THREE.Mesh(
    new THREE.SphereGeometry(item.radius, 24, 16), plain(item.color, 0.6)), item.name);
  return { update(frame, share) {
    const place = at(frame);
    ball.visible = Number.isFinite(place.x + place.y + place.z);
    if (ball.visible) ball.position.copy(place);
  } };
}
function makeArrow(item) {
  const at = rowReader(item.points), vector = rowReader(item.vectors);
  const group = named(new THREE.Group(), item.name), up = new THREE.Vector3(0, 1, 0);
  const shaft = new THREE.Mesh(
    new THREE.CylinderGeometry(item.radius, item.radius, 1, 16), plain(item.color, 1));
  const head = new THREE.Mesh(
    new THREE.ConeGeometry(2.6 * item.radius, 6 * item.radius, 20), plain(item.color, 1));
  group.add(shaft, head);
  return { update(frame, share) {
    const value = vector(frame, share), size = value.length();
    group.visible = size >= item.threshold;
    if (!group.visible) return;
    const length = size * item.scale;
    group.position.copy(at(frame, share));
    group.quaternion.setFromUnitVectors(up, value.normalize());
    shaft.scale.y = length;
    shaft.position.y = length / 2;
    head.position.y = length + 3 * item.radius;
  } };
}
const makers = { Trail: makeTrail, Marker: makeMarker, Arrow: makeArrow };
const overlays = SCENE.overlays.map((item) => makers[item.kind](item));
const trails = overlays.filter((overlay) => "seen" in overlay);

// ---- time ------------------------------------------------------------------------------------
let now = 0, playing = false, speed = 1, stamp = null;
const from = new THREE.Quaternion(), to = new THREE.Quaternion();

function locate(t) {
  let low = 0, high = last;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] - start <= t) low = middle; else high = middle - 1;
  }
  if (low === last) return [last, 0];
  return [low, (t - (times[low] - start)) / (times[low + 1] - times[low])];
}
function seek(t) {
  if (!Number.isFinite(t)) return;
  now = Math.min(Math.max(t, 0), duration);
  const [frame, share] = locate(now);
  const { objects, poses } = moving, width = 7 * objects.length;
  objects.forEach((object, b) => {
    const i = frame * width + 7 * b, j = Math.min(frame + 1, last) * width + 7 * b;
    const mix = (k) => poses[i + k] + share * (poses[j + k] - poses[i + k]);
    object.position.set(mix(0), mix(1), mix(2));
    from.set(poses[i + 4], poses[i + 5], poses[i + 6], poses[i + 3]);
    to.set(poses[j + 4], poses[j + 5], poses[j + 6], poses[j + 3]);
    object.quaternion.copy(share > 0 ? from.slerp(to, share) : from).normalize();
  });
  for (const overlay of overlays) overlay.update(frame, share);
  if (following) followTrail(frame, share);
  byId("time").value = now;
  byId("clock").textContent = now.toFixed(2) + " / " + duration.toFixed(2) + " s";
  byId("readouts").textContent = SCENE.readouts.map(
    (r, k) => r.name + "  " + values[k][frame].toPrecision(3)).join("\n");
  fitDepth();
  viewer.set_dirty();
}
function setPlaying(on) {
  playing = on && duration > 0;
  stamp = null;
  if (playing && now >= duration) seek(0);
  byId("play").textContent = playing ? "\u275A\u275A" : "\u25B6";
  if (playing) requestAnimationFrame(tick);
}
function tick(clock) {
  if (!playing) return;
  if (stamp !== null) seek(now + speed * (clock - stamp) / 1000);
  stamp = clock;
  if (now >= duration) setPlaying(false); else requestAnimationFrame(tick);
}
function setSpeed(value) {
  if (!(value > 0 && Number.isFinite(value))) return;
  speed = value;
  const option = [...byId("speed").options].find((o) => Number(o.value) === value);
  if (option) option.selected = true;
}

// ---- controls, keys, and messages from a slider beside the frame -------------------------------
byId("head").querySelector("h1").textContent = SCENE.title;
for (const item of SCENE.overlays) {
  const label = document.createElement("span"), dot = document.createElement("i");
  dot.style.background = tint(item.color);
  label.append(dot, item.name);
  byId("key").appendChild(label);
}
SCENE.cameras.forEach((camera, i) => {
  const button = document.createElement("button");
  button.textContent = camera.name;
  button.onclick = () => look(i);
  byId("cameras").append(button, " ");
});
byId("time").max = duration;
byId("time").oninput = (event) => { setPlaying(false); seek(Number(event.target.value)); };
byId("play").onclick = () => setPlaying(!playing);
byId("speed").onchange = (event) => setSpeed(Number(event.target.value));
window.addEventListener("keydown", (event) => {
  if (event.target.tagName === "SELECT") return;
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (event.key === " ") setPlaying(!playing);
  else if (step) {
    setPlaying(false);
    seek(times[Math.min(Math.max(locate(now)[0] + step, 0), last)] - start);
  } else if (event.key >= "1" && event.key <= "9") look(Number(event.key) - 1);
  else return;
  event.preventDefault();
});
window.addEventListener("message", (event) => {
  const message = event.data;
  if (!message || message.cmcPlayback !== SCENE.id) return;
  if ("seek" in message) { setPlaying(false); seek(Number(message.seek)); }
  if ("play" in message) setPlaying(Boolean(message.play));
  if ("speed" in message) setSpeed(Number(message.speed));
  if ("camera" in message) look(Number(message.camera));
});
if (duration === 0) {
  for (const id of ["play", "time", "clock", "speed"]) byId(id).style.display = "none";
}
look(0);
seek(0);
if (SCENE.live) viewer.connect("ws://" + location.host + "/socket");
window.cmcPlayback = { viewer, seek, look, setPlaying, setSpeed,
  state: () => ({ time: now, playing, speed }) };
})();
