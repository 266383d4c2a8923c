// Sliders without a kernel: pictures from the table of cmc.view.canvas, or a word that there are none.
// canvas.js follows in the same module.

const EXACT = 64, CODES = 65532;
const NO_KERNEL = "Without a kernel the picture no longer follows the controls: run the cell again.";
const ONE_AT_A_TIME = "Without a kernel one control moves at a time: the others are at their start.";

async function inflate(data) {
  const bytes = new Uint8Array(data.buffer ?? data, data.byteOffset ?? 0, data.byteLength);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

class Table {
  static async open(packed) {
    const [layouts, halves] = await Promise.all([packed.layouts, packed.words].map(inflate));
    return new Table(packed, JSON.parse(new TextDecoder().decode(layouts)), halves);
  }

  constructor(packed, layouts, halves) {
    Object.assign(this, packed, { layouts });
    const total = halves.length / 2, words = new Uint16Array(total);
    let at = 0;
    this.frames = this.sizes.map((size, k) => {  // each frame is a difference to the one before
      const before = this.sizes[k - 1] === size ? at - size : -1, first = at;
      for (let i = 0; i < size; i++, at++) {
        words[at] = 256 * halves[at] + halves[total + at] + (before < 0 ? 0 : words[before + i]);
      }
      return words.subarray(first, at);
    });
  }

  // Position in the table of the controls' indices, of which number `moved` has just moved.
  position(indices, moved) {
    if (this.full) return indices.reduce((sum, index, k) => sum * this.counts[k] + index, 0);
    return this.counts.slice(0, moved).reduce((a, b) => a + b, 0) + indices[moved];
  }

  frame(position) {
    const layout = this.layouts[position];
    if (layout.error) return layout;
    const found = layout.time ? [[layout.time, false]] : [];
    for (const panel of layout.panels) {
      for (const layer of panel.layers) {
        for (const [name, ref] of Object.entries(layer)) {
          if (ref?.shape) found.push([ref, panel.log && (name === "y" || name === "y2")]);
        }
      }
    }
    found.sort((a, b) => a[0].at - b[0].at);
    const size = ([ref]) => ref.shape.reduce((a, b) => a * b, 1);
    const data = new Float32Array(found.reduce((sum, item) => sum + size(item), 0));
    const words = this.frames[position];
    let from = 0;
    found.forEach((item, k) => {
      const count = size(item), [low, high] = this.ranges[k], start = item[0].at;
      if (count <= EXACT) {
        data.set(new Float32Array(words.slice(from, from + 2 * count).buffer), start);
        from += 2 * count;
        return;
      }
      for (let i = 0; i < count; i++, from++) {
        const code = words[from];
        const value = code <= CODES ? low + (high - low) * code / CODES
          : [-Infinity, Infinity, NaN][code - CODES - 1];
        data[start + i] = item[1] ? 10 ** value : value;
      }
    });
    return { ...layout, serial: position + 1, data };
  }
}

// anywidget gives a widget two seconds to begin, and other widgets may take longer: no waiting here.
function initialize({ model }) {
  const ids = model.get("controls");
  if (ids?.length) connect(model, ids);
}

async function connect(model, ids) {
  const controls = await Promise.all(ids.map((id) => model.widget_manager.get_model(id)));
  const values = model.get("values");  // of sliders; null where a control has an index or is a box
  const index = (k) => {
    const now = controls[k].get("value");
    if (!values[k]) return controls[k].get("index") ?? Number(now);
    return values[k].reduce((best, v, i) =>
      (Math.abs(v - now) < Math.abs(values[k][best] - now) ? i : best), 0);
  };
  const rewind = (k, start) => {
    if (values[k]) controls[k].set("value", values[k][start]);
    else if (controls[k].get("index") === undefined) controls[k].set("value", Boolean(start));
    else controls[k].set("index", start);
  };
  let table = null, busy = false;
  const follow = async (k) => {
    if (busy || controls[k].comm_live) return;
    const packed = model.get("table");
    if (!packed?.words) {
      model.set("note", NO_KERNEL);
      return;
    }
    table ??= Table.open(packed);
    const opened = await table;
    busy = true;
    if (!opened.full) controls.forEach((_, j) => j === k || rewind(j, opened.starts[j]));
    busy = false;
    const frame = opened.frame(opened.position(controls.map((_, j) => index(j)), k));
    model.set("note", opened.full ? "" : ONE_AT_A_TIME);
    model.set("error", frame.error ?? "");
    if (!frame.error) model.set("frame", frame);
  };
  controls.forEach((control, k) => control.on("change:value change:index", () => follow(k)));
}
