"use strict";
// Plays CONTENT, which page.py writes: scenes of meshcat commands that draw them and packed poses
// that move them, side by side under one time slider.
(() => {
const byId = (id) => document.getElementById(id);
const THREE = MeshCat.THREE;
const tint = (number) => "#" + number.toString(16).padStart(6, "0");
const upright = (p) => new THREE.Vector3(p.x, p.z, -p.y);  // the model's z is up, three.js's y

function unpack(text, Type) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return Type ? new Type(bytes.buffer) : bytes;
}
function element(tag, name, parent) {
  const node = document.createElement(tag);
  node.className = name;
  return parent.appendChild(node);
}

// One scene in its pane: {duration, names, step, seek, look, viewer}.
function stage(SCENE) {
const pane = element("div", "pane", byId("panes"));
const viewer = new MeshCat.Viewer(element("div", "canvas", pane));
const resize = viewer.set_3d_pane_size.bind(viewer);
viewer.set_3d_pane_size = (width, height) => resize(  // the bar below must not hide the scene
  width ?? pane.clientWidth, height ?? window.innerHeight - byId("bar").offsetHeight);
// A mesh or texture that is used again comes as a stand-in with the first one's uuid.
const first = {}, place = viewer.set_object.bind(viewer);
viewer.set_object = (path, object) => {
  const once = (thing) => first[thing.uuid] ??= thing;
  object.traverse((part) => {
    if (part.geometry) part.geometry = once(part.geometry);
    if (part.material?.map) part.material.map = once(part.material.map);
  });
  place(path, object);
};

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

// ---- overlays --------------------------------------------------------------------------------
function rowReader(text) {
  const rows = unpack(text, Float32Array), end = rows.length / 3 - 1;
  return (frame, share = 0) => {
    const i = 3 * Math.min(frame, end), j = 3 * Math.min(frame + 1, end);
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

// Six-sided tubes, each between two points that follow each other in `ends`, as triangles.
const SIDES = 6;
function tubeFaces(count) {
  const faces = [];
  for (let k = 0; k < count; k++) {
    for (let s = 0; s < SIDES; s++) {
      const a = 2 * SIDES * k + s, b = 2 * SIDES * k + (s + 1) % SIDES;
      faces.push(a, b, a + SIDES, b, b + SIDES, a + SIDES);
    }
  }
  return Uint32Array.from(faces);
}
function tubeCorners(ends, radius, corners) {
  const axis = new THREE.Vector3(), across = new THREE.Vector3(), over = new THREE.Vector3();
  for (let k = 0, at = 0; k < ends.length; k += 6) {
    axis.set(ends[k + 3] - ends[k], ends[k + 4] - ends[k + 1], ends[k + 5] - ends[k + 2]);
    const size = axis.toArray().map(Math.abs), least = size.indexOf(Math.min(...size));
    across.set(0, 0, 0).setComponent(least, 1).cross(axis).normalize();
    over.crossVectors(axis, across).normalize();
    for (const end of [k, k + 3]) {
      for (let s = 0; s < SIDES; s++) {
        const c = radius * Math.cos(2 * Math.PI * s / SIDES);
        const d = radius * Math.sin(2 * Math.PI * s / SIDES);
        for (let i = 0; i < 3; i++) {
          corners[at++] = ends[end + i] + c * across.getComponent(i) + d * over.getComponent(i);
        }
      }
    }
  }
}
// A trail is a thin tube (seen from near) and a line (seen from far), both cut at the current time.
function makeTrail(item) {
  const at = rowReader(item.points), points = [], ends = [];
  for (let k = 0; k <= last; k++) points.push(at(k));
  for (let k = 0; k < last; k++) ends.push(...points[k].toArray(), ...points[k + 1].toArray());
  const tube = new THREE.BufferGeometry(), corners = new Float32Array(6 * SIDES * last);
  tubeCorners(ends, item.radius, corners);
  tube.setAttribute("position", new THREE.BufferAttribute(corners, 3));
  tube.setIndex(new THREE.BufferAttribute(tubeFaces(last), 1));
  tube.computeVertexNormals();
  const line = new THREE.BufferGeometry().setFromPoints(points);
  const group = named(new THREE.Group(), item.name);
  const skin = new THREE.MeshBasicMaterial({ color: item.color, side: THREE.DoubleSide });
  group.add(new THREE.Mesh(tube, skin));
  group.add(new THREE.Line(line, new THREE.LineBasicMaterial({ color: item.color })));
  group.traverse((part) => { part.frustumCulled = false; });
  return { update(frame) {
    tube.setDrawRange(0, 6 * SIDES * frame);
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
// A word of the same size from near and far, in front of everything.
function makeLabel(item) {
  const at = rowReader(item.points), canvas = document.createElement("canvas");
  const pen = canvas.getContext("2d"), font = "30px system-ui, sans-serif";
  pen.font = font;
  canvas.width = Math.ceil(pen.measureText(item.name).width) + 24;
  canvas.height = 88;  // the word in the upper half, so that the point below it stays free
  pen.fillStyle = "rgba(255, 255, 255, 0.8)";
  pen.fillRect(0, 0, canvas.width, 44);
  pen.font = font;
  pen.fillStyle = "#1f2933";
  pen.fillText(item.name, 12, 32);
  const sprite = named(new THREE.Sprite(new THREE.SpriteMaterial({
    map: new THREE.CanvasTexture(canvas), sizeAttenuation: false, depthTest: false, fog: false,
  })), item.name);
  sprite.renderOrder = 9;
  return { update(frame, share) {
    sprite.position.copy(at(frame, share));
    const size = 0.1 * Math.tan(viewer.camera.fov * Math.PI / 360);
    sprite.scale.set(size * canvas.width / canvas.height, size, 1);
  } };
}
// Triangles whose corners move: the corners, and what to call when they have.
function makeSurface(item, faces, count) {
  const shape = new THREE.BufferGeometry(), corners = new Float32Array(count);
  shape.setAttribute("position", new THREE.BufferAttribute(corners, 3));
  shape.setIndex(new THREE.BufferAttribute(faces, 1));
  const look = new THREE.MeshPhongMaterial({
    color: item.color, opacity: item.opacity, transparent: item.opacity < 1,
    side: THREE.DoubleSide, shininess: 20, specular: 0x222222 });
  if (item.map) {
    shape.setAttribute("uv", new THREE.BufferAttribute(unpack(item.uv, Float32Array), 2));
    look.map = new THREE.TextureLoader().load(item.map, () => viewer.set_dirty());
    look.map.wrapS = look.map.wrapT = THREE.RepeatWrapping;
  }
  const mesh = named(new THREE.Mesh(shape, look), item.name);
  mesh.castShadow = mesh.receiveShadow = true;
  mesh.frustumCulled = false;
  return [corners, () => {
    shape.attributes.position.needsUpdate = true;
    shape.computeVertexNormals();
  }];
}
// A skin: each corner is the weighted mean of where its bones alone would take it.
function makeSkin(item) {
  const rest = unpack(item.corners, Float32Array);
  const faces = unpack(item.faces, Uint32Array);
  const [corners, done] = makeSurface(item, faces, rest.length);
  const bones = item.bones.map((bone) => ({
    object: moving.objects[bone.body], index: unpack(bone.index, Uint32Array),
    weight: unpack(bone.weight, Float32Array), back: new THREE.Matrix4().compose(
      new THREE.Vector3(bone.rest[0], bone.rest[1], bone.rest[2]),
      new THREE.Quaternion(bone.rest[4], bone.rest[5], bone.rest[6], bone.rest[3]),
      new THREE.Vector3(1, 1, 1)).invert(),
  }));
  const turn = new THREE.Matrix4();
  return { update() {
    corners.fill(0);
    for (const { object, index, weight, back } of bones) {
      object.updateMatrix();
      const m = turn.multiplyMatrices(object.matrix, back).elements;
      index.forEach((v, k) => {
        const w = weight[k], x = rest[3 * v], y = rest[3 * v + 1], z = rest[3 * v + 2];
        for (let r = 0; r < 3; r++) {
          corners[3 * v + r] += w * (m[r] * x + m[4 + r] * y + m[8 + r] * z + m[12 + r]);
        }
      });
    }
    done();
  } };
}
// A cloth, or tubes of a radius: corners, or ends of tubes, as shares of a box, 16 bits each.
function makeCloth(item) {
  const shares = unpack(item.shares, Uint16Array), width = 3 * item.count;
  const frames = shares.length / width, tubes = "radius" in item;
  const faces = tubes ? tubeFaces(item.count / 2) : unpack(item.faces, Uint32Array);
  const [corners, done] = makeSurface(item, faces, tubes ? SIDES * width : width);
  const places = tubes ? new Float32Array(width) : corners;
  let shown = -1;
  return { update(frame, share) {
    if (shown === frame + share || (frames === 1 && shown >= 0)) return;
    shown = frame + share;
    const i = width * Math.min(frame, frames - 1), j = width * Math.min(frame + 1, frames - 1);
    for (let k = 0; k < width; k++) {
      const value = shares[i + k] + share * (shares[j + k] - shares[i + k]);
      places[k] = item.low[k % 3] + item.side[k % 3] * value / 65535;
    }
    if (tubes) tubeCorners(places, item.radius, corners);
    done();
  } };
}
const makers = { Trail: makeTrail, Marker: makeMarker, Arrow: makeArrow, Label: makeLabel };
const overlays = SCENE.overlays.map((item) => makers[item.kind](item));
overlays.push(...SCENE.cloths.map(makeCloth), ...SCENE.skins.map(makeSkin));

// ---- camera: presets are in the model's coordinates, in rows of one or of all frames -------------
const presets = SCENE.cameras.map((item) => ({
  ...item, position: rowReader(item.position), target: rowReader(item.target),
  up: rowReader(item.up) }));
let active = null, seen = null;
const stand = (preset, frame, share) => ["position", "target", "up"].map(
  (key) => upright(preset[key](frame, share)));
function look(name) {
  const preset = presets.find((item) => item.name === name);
  if (!preset) return;
  active = preset;
  seen = stand(preset, ...locate(now));
  viewer.camera.fov = preset.field_of_view;
  viewer.camera.position.copy(seen[0]);
  viewer.controls.target.copy(seen[1]);
  viewer.camera.up.copy(seen[2]);
  fitDepth();
  viewer.controls.update();
  viewer.set_dirty();
}
// The camera goes along with its preset; what the mouse has changed since is kept.
function carry(frame, share) {
  const next = stand(active, frame, share);
  viewer.camera.position.add(next[0].clone().sub(seen[0]));
  viewer.controls.target.add(next[1].clone().sub(seen[1]));
  viewer.camera.up.copy(next[2]);
  seen = next;
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
viewer.controls.addEventListener("change", fitDepth);

// ---- time ------------------------------------------------------------------------------------
const from = new THREE.Quaternion(), to = new THREE.Quaternion();
let now = 0;

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
  if (active) carry(frame, share);
  for (const overlay of overlays) overlay.update(frame, share);
  readouts.textContent = SCENE.readouts.map(
    (r, k) => r.name + "  " + values[k][frame].toPrecision(3)).join("\n");
  fitDepth();
  viewer.set_dirty();
}

const head = element("div", "head", pane);
element("h1", "", head).textContent = SCENE.title;
const key = element("div", "key", head), readouts = element("div", "readouts", head);
for (const item of SCENE.overlays) {
  if (item.kind === "Label") continue;
  const label = element("span", "", key);
  element("i", "", label).style.background = tint(item.color);
  label.append(item.name);
}
if (presets.length) look(presets[0].name);
seek(0);
const frameTime = (step) =>
  times[Math.min(Math.max(locate(now)[0] + step, 0), last)] - start;
return { viewer, duration, seek, look, frameTime, names: SCENE.cameras.map((c) => c.name) };
}

// ---- all scenes together ----------------------------------------------------------------------
let stages;
try {
  stages = CONTENT.scenes.map(stage);
} catch (error) {
  console.error(error);
  const note = element("p", "", document.body);
  note.id = "failure";
  note.textContent = "This page needs WebGL, which this browser does not offer: " + error.message;
  return;
}
const duration = Math.max(...stages.map((s) => s.duration));
let now = 0, playing = false, speed = 1, stamp = null;

function seek(t) {
  if (!Number.isFinite(t)) return;
  now = Math.min(Math.max(t, 0), duration);
  for (const each of stages) each.seek(now);
  byId("time").value = now;
  byId("clock").textContent = now.toFixed(2) + " / " + duration.toFixed(2) + " s";
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
const names = [...new Set(stages.flatMap((s) => s.names))];
function look(index) {
  if (!(index in names)) return;
  for (const each of stages) each.look(names[index]);
  byId("cameras").querySelectorAll("button").forEach(
    (b, i) => b.setAttribute("aria-pressed", String(i === index)));
}

// ---- controls, keys, and messages from the page around the frame -------------------------------
names.forEach((name, i) => {
  const button = document.createElement("button");
  button.textContent = name;
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
    seek(stages[0].frameTime(step));
  } else if (event.key >= "1" && event.key <= "9") look(Number(event.key) - 1);
  else return;
  event.preventDefault();
});
window.addEventListener("message", (event) => {
  const message = event.data;
  if (!message || message.cmcPlayback !== CONTENT.id) return;
  setPlaying(false);
  seek(Number(message.seek));
});
if (duration === 0) {
  for (const id of ["play", "time", "clock", "speed"]) byId(id).style.display = "none";
}
look(0);
seek(0);
if (CONTENT.live) stages[0].viewer.connect("ws://" + location.host + "/socket");
window.cmcPlayback = { viewer: stages[0].viewer, stages, seek, look, setPlaying, setSpeed,
  state: () => ({ time: now, playing, speed }) };
})();
