"use strict";
// Runs the worlds by the clock and reports them. `port` is the worker itself or one end of a channel.
function serve(port, load) {
  let mj, task, arms = [], running = false, planning = true, clock = 0, pushEnds = Infinity;
  const report = () => port.postMessage({ kind: "state", arms: arms.map(({ world }) => ({
    xpos: Float64Array.from(world.data.xpos), xquat: Float64Array.from(world.data.xquat),
    tip: world.tip, target: world.target, goal: world.goal, force: world.force, pushed: world.pushed,
    time: world.tick * task.tick,
  })) });
  function advance() {
    const now = performance.now() / 1000;
    let debt = Math.min(now - clock, 0.2);  // a page that slept does not race afterwards
    if (!running || debt < task.tick) return;
    for (; debt >= task.tick; debt -= task.tick) {
      if (arms[0].world.tick >= pushEnds) { arms.forEach(({ world }) => world.push([0, 0, 0])); pushEnds = Infinity; }
      for (const arm of arms) arm.world.follow(arm.policy, planning);
    }
    clock = now - debt;
    report();
  }
  function restart(start) {
    for (const { world } of arms) { world.push([0, 0, 0]); world.reset(task.starts[start]); }
    pushEnds = Infinity;
    report();
  }
  const answers = {
    async init(message) {
      task = message.task;
      mj = await load({ wasmBinary: message.wasm });
      arms = message.policies.map((policy) => ({ world: new World(mj, task), policy }));
      port.postMessage({ kind: "ready" });
      report();
      setInterval(advance, 5);
    },
    run({ on }) { running = on; clock = performance.now() / 1000; },
    policy({ arm, policy }) { arms[arm].policy = policy; },
    plan({ on }) {
      planning = on;
      if (!on) for (const { world } of arms) world.setTarget(world.target, world.targetRotation);
    },
    target({ position }) { for (const { world } of arms) world.setTarget(position); report(); },
    push({ force, seconds }) {
      for (const { world } of arms) world.push(force);
      pushEnds = arms[0].world.tick + (seconds ?? Infinity) / task.tick;
    },
    restart({ start }) { restart(start); },
    // A whole episode at once, as fast as it goes: joints, and distances to the sub-goal.  With
    // `target` no planner moves it; `force` acts on the tip in the ticks of `span`.
    replay({ policy, start, ticks, target, force, span = [0, 0] }) {
      const world = new World(mj, task), qpos = [], away = [];
      world.reset(task.starts[start]);
      if (target) world.setTarget(target);
      for (let k = 0; k < ticks; k++) {
        qpos.push(Array.from(world.data.qpos));
        world.push(k >= span[0] && k < span[1] ? force : [0, 0, 0]);
        world.follow(policy, !target);
        away.push(length(world.target.map((x, i) => x - world.tip[i])));
      }
      port.postMessage({ kind: "replayed", qpos, away });
    },
  };
  port.onmessage = ({ data }) => Promise.resolve(answers[data.kind](data)).catch(
    (error) => port.postMessage({ kind: "failed", text: String(error && error.message || error) }));
}
