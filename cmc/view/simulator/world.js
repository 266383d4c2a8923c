"use strict";
// One Panda world in the browser: MuJoCo's physics, and the project's control law, latent signals and
// policies written once more in JavaScript. A test plays whole episodes here and in Python and compares.
const JOINTS = 7;

// ---- small linear algebra: matrices are arrays of rows ----------------------------------------
const dot = (a, b) => { let sum = 0; for (let k = 0; k < a.length; k++) sum += a[k] * b[k]; return sum; };
const cross = (a, b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const times = (matrix, vector) => matrix.map((row) => dot(row, vector));
const clip = (value, low, high) => Math.min(Math.max(value, low), high);
const length = (vector) => Math.sqrt(dot(vector, vector));
const block = (matrix, from, to) => matrix.slice(from, to).map((row) => row.slice(from, to));

// Solve with a positive matrix by Cholesky; pivots are kept above `floor`.
function solve(matrix, rights, floor = 0) {
  const n = matrix.length, L = matrix.map((row) => Array.from(row));
  for (let j = 0; j < n; j++) {
    let pivot = L[j][j];
    for (let k = 0; k < j; k++) pivot -= L[j][k] * L[j][k];
    L[j][j] = Math.sqrt(Math.max(pivot, floor));
    for (let i = j + 1; i < n; i++) {
      let sum = L[i][j];
      for (let k = 0; k < j; k++) sum -= L[i][k] * L[j][k];
      L[i][j] = sum / L[j][j];
    }
  }
  return rights.map((right) => {
    const x = Array.from(right);
    for (let i = 0; i < n; i++) {
      for (let k = 0; k < i; k++) x[i] -= L[i][k] * x[k];
      x[i] /= L[i][i];
    }
    for (let i = n - 1; i >= 0; i--) {
      for (let k = i + 1; k < n; k++) x[i] -= L[k][i] * x[k];
      x[i] /= L[i][i];
    }
    return x;
  });
}

// ---- quaternions (w, x, y, z) and rotation vectors ---------------------------------------------
function quatTimes(a, b) {
  const v = cross(a.slice(1), b.slice(1));
  return [a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    ...[0, 1, 2].map((k) => a[0] * b[k + 1] + b[0] * a[k + 1] + v[k])];
}
function rotationVector(q) {
  const s = q[0] < 0 ? q.map((x) => -x) : q, sine = length(s.slice(1));
  const scale = sine > 1e-12 ? 2 * Math.atan2(sine, s[0]) / sine : 2;
  return s.slice(1).map((x) => scale * x);
}
const UP = [0, -1, 0, 0];  // times it, an orientation is told from pointing straight down
function poseQuat(rotation) {
  const angle = length(rotation), scale = angle > 1e-9 ? Math.sin(angle / 2) / angle : 0.5;
  return quatTimes([Math.cos(angle / 2), ...rotation.map((x) => scale * x)], [0, 1, 0, 0]);
}

// ---- networks: layers of {w (in x out, row by row), b, inputs, outputs} -------------------------
function perceptron(layers, x) {
  for (let l = 0; l < layers.length; l++) {
    const { w, b, inputs, outputs } = layers[l], y = new Array(outputs);
    for (let j = 0; j < outputs; j++) {
      let sum = b ? b[j] : 0;
      for (let i = 0; i < inputs; i++) sum += x[i] * w[i * outputs + j];
      y[j] = l < layers.length - 1 ? Math.tanh(sum) : sum;
    }
    x = y;
  }
  return x;
}

// Low-level action in [-1, 1] from the latent signal and its integral.
function lowLevel(low, latent, integral) {
  const seen = (i) => [Math.fround(latent[i]), Math.fround(integral[i])];
  if (low.kind === "none") return latent.map(() => 0);
  if (low.kind === "gain") return latent.map((_, i) => Math.tanh(low.gain[i] * (seen(i)[0] + seen(i)[1])));
  return latent.map((_, i) => Math.tanh(perceptron(low.networks[i], seen(i))[0]));
}

// ---- the world ----------------------------------------------------------------------------------
class World {
  // task: what `cmc.studies.live` writes; mj: the loaded MuJoCo module.
  constructor(mj, task) {
    this.mj = mj;
    this.task = task;
    this.model = mj.MjModel.from_xml_string(task.xml);
    this.data = new mj.MjData(this.model);
    const id = (kind, name) => mj.mj_name2id(this.model, mj.mjtObj[kind].value, name);
    this.nominalSite = id("mjOBJ_SITE", "tip_nominal");
    this.tipSite = id("mjOBJ_SITE", "tip");
    this.hand = id("mjOBJ_BODY", "hand");
    this.nv = this.model.nv;
    this.nq = this.model.nq;
    this.mass = new mj.DoubleBuffer(this.nv * this.nv);
    this.lever = [0, 1, 2].map((k) =>
      this.model.site_pos[3 * this.nominalSite + k] - this.model.body_ipos[3 * this.hand + k]);
    this.pushed = [0, 0, 0];
    this.action = new Array(6).fill(0);
    this.reset(task.starts[0]);
  }

  // start: {qpos, goal}
  reset(start) {
    const { mj, model, data } = this;
    mj.mj_resetData(model, data);
    data.qpos.set(start.qpos);
    mj.mj_step1(model, data);
    this.goal = start.goal;
    this.force = 0;
    this.tick = 0;
    this.observe();
    this.target = this.nominal;
    this.targetRotation = this.rotation;
    this.targetQuat = poseQuat(this.rotation);
    this.aim();
    this.integral = this.latent.map((y, i) => this.task.integrates[i] * this.task.tick * y);
  }

  // Jacobian, pose and velocity of the tip in the present state.
  observe() {
    const { data } = this, p = Array.from(data.site_xpos.slice(3 * this.nominalSite, 3 * this.nominalSite + 3));
    const axes = data.xaxis, anchors = data.xanchor, qvel = data.qvel;
    const columns = [];
    for (let j = 0; j < JOINTS; j++) {
      const axis = Array.from(axes.slice(3 * j, 3 * j + 3));
      columns.push([...cross(axis, p.map((x, k) => x - anchors[3 * j + k])), ...axis]);
    }
    this.jacobian = [0, 1, 2, 3, 4, 5].map((k) => columns.map((column) => column[k]));
    this.nominal = p;
    this.quat = Array.from(data.xquat.slice(4 * this.hand, 4 * this.hand + 4));
    this.velocity = times(this.jacobian, Array.from(qvel.slice(0, JOINTS)));
    this.rotation = rotationVector(quatTimes(this.quat, UP));
    this.tip = p;
    this.tipVelocity = this.velocity;
    if (this.task.compliant) {
      const R = data.xmat.slice(9 * this.hand, 9 * this.hand + 9);
      this.tip = Array.from(data.site_xpos.slice(3 * this.tipSite, 3 * this.tipSite + 3));
      this.tipVelocity = this.velocity.map((v, k) =>
        k < 3 ? v + R[3 * k] * qvel[JOINTS] + R[3 * k + 1] * qvel[JOINTS + 1] : v);
    }
  }

  // Control error e towards the target, and y = K1 e - K2 v (mapping_pos).
  aim() {
    const { task } = this;
    let e = this.target.map((x, k) => x - this.nominal[k]);
    if (task.error_limit !== null) {
      const size = length(e);
      e = e.map((x) => x * task.error_limit / Math.max(size, task.error_limit));
    }
    const conjugate = this.quat.map((x, k) => k ? -x : x);
    this.error = [...e, ...rotationVector(quatTimes(this.targetQuat, conjugate))];
    this.latent = this.error.map((x, i) => task.K1[i] * x - task.K2[i] * this.velocity[i]);
  }

  // Joint torques for x'' = K_p e - K_d v + u (2nd_sys), as in cmc.robot.
  torque(u) {
    const { task, data, nv, jacobian: J } = this;
    const reference = u.map((a, i) => task.K_p[i] * this.error[i] - task.K_d[i] * this.velocity[i] + a);
    this.mj.mj_fullM(this.model, data, this.mass);
    const flat = this.mass.GetView();
    const M = Array.from({ length: nv }, (_, i) => Array.from(flat.subarray(i * nv, (i + 1) * nv)));
    const qpos = data.qpos, qvel = data.qvel, posture = new Array(nv).fill(0);
    for (let j = 0; j < JOINTS; j++) {
      posture[j] = task.posture_stiffness * (task.posture[j] - qpos[j]) - task.posture_damping * qvel[j];
    }
    const wide = J.map((row) => [...row, ...new Array(nv - JOINTS).fill(0)]);
    const disturbed = times(wide, posture), floor = task.pivot_floor;
    let tau;
    if (task.form === "acceleration") {  // tau_task_space_control
      const JJ = J.map((a) => J.map((b) => dot(a, b)));
      const [x] = solve(JJ, [reference.map((r, k) => r - disturbed[k])], floor);
      tau = times(M, posture.map((q, j) => q + wide.reduce((sum, row, k) => sum + row[j] * x[k], 0)));
    } else {  // Nakanishi et al. 2008, 3.3
      const solved = solve(M, wide), inverse = solved.map((a) => wide.map((b) => dot(a, b)));
      let force;
      if (task.split) {
        const [undo] = solve(inverse, [disturbed], floor);
        const part = (from, to) => solve(block(inverse, from, to), [reference.slice(from, to)], floor)[0];
        force = [...part(0, 3), ...part(3, 6)].map((f, k) => f - undo[k]);
      } else {
        [force] = solve(inverse, [reference.map((r, k) => r - disturbed[k])], floor);
      }
      tau = times(M, posture).map((t, j) => t + wide.reduce((sum, row, k) => sum + row[j] * force[k], 0));
    }
    const bias = data.qfrc_bias, passive = data.qfrc_passive;
    return tau.slice(0, JOINTS).map((t, j) => t + bias[j] - passive[j]);
  }

  // A force (3), N, on the nominal tip, in world axes; it lasts until the next call.
  push(force) {
    this.pushed = force;
    const R = this.data.xmat.slice(9 * this.hand, 9 * this.hand + 9);
    const arm = [0, 1, 2].map((k) => dot(R.slice(3 * k, 3 * k + 3), this.lever));
    this.data.xfrc_applied.set([...force, ...cross(arm, force)], 6 * this.hand);
  }

  // One tick with a low-level action in [-1, 1]; the torque is held over it.
  step(action) {
    const { mj, model, data, task } = this;
    this.action = action;
    if (this.pushed.some((f) => f)) this.push(this.pushed);
    data.ctrl.set(this.torque(action.map((a, i) => clip(a, -1, 1) * task.u_limit[i])));
    this.force = 0;
    for (let k = 0; k < task.substeps; k++) {
      mj.mj_step2(model, data);
      this.force = Math.max(this.force, length(data.sensordata.slice(0, 3)));
      mj.mj_step1(model, data);
    }
    this.observe();
    this.aim();
    this.integral = this.integral.map((s, i) => s + task.integrates[i] * task.tick * this.latent[i]);
    this.tick += 1;
  }

  // A sub-goal in the task's units, clamped as in Python; the integral starts anew.
  setSubgoal(action) {
    const { task } = this;
    const a = action.map((x, k) => clip(x, task.subgoal_low[k], task.subgoal_high[k]));
    if (task.increments) {
      this.setTarget(this.nominal.map((x, k) => x + a[k]), this.rotation.map((x, k) => x + a[3 + k]));
    } else {
      this.setTarget(a, [0, 0, 0]);
    }
  }

  setTarget(position, rotation = [0, 0, 0]) {
    const { task } = this;
    this.target = position.map((x, k) => clip(x, task.workspace_low[k], task.workspace_high[k]));
    const size = Math.max(length(rotation), task.tilt_limit);
    this.targetRotation = rotation.map((x) => x * task.tilt_limit / size);
    this.targetQuat = poseQuat(this.targetRotation);
    this.aim();
    this.integral = this.latent.map((y, i) => task.integrates[i] * task.tick * y);
  }

  // The planner's view: (field - shift) * scale, field by field.
  planned() {
    const { task, data } = this, seen = [];
    const fields = { position: this.tip, rotation: this.rotation, velocity: this.tipVelocity, goal: this.goal,
      sliders: Array.from(data.qpos.slice(this.nq - 3)), slider_velocity: Array.from(data.qvel.slice(this.nv - 3)) };
    for (const { name, shift, scale } of task.planning) {
      fields[name].forEach((x, k) => seen.push(Math.fround((x - shift[k]) * scale[k])));
    }
    return seen;
  }

  // One tick under a policy {planner, low}; without `plan` the sub-goal stays where it is.
  follow(policy, plan = true) {
    const { task } = this;
    if (plan && this.tick % task.horizon === 0) {
      const a = perceptron(policy.planner, this.planned()).map(Math.tanh);
      this.setSubgoal(a.map((x, k) =>
        task.subgoal_low[k] + 0.5 * (x + 1) * (task.subgoal_high[k] - task.subgoal_low[k])));
    }
    this.step(lowLevel(policy.low, this.latent, this.integral));
  }
}
