// Sliders without a kernel: pictures from the table of cmc.view.canvas, or a word that there are none.
// canvas.js follows in the same module.

const NO_KERNEL = "Without a kernel the picture no longer follows the controls: run the cell again.";
const ONE_AT_A_TIME = "Without a kernel one control moves at a time: the others are at their start.";

async function inflate(data) {
  const bytes = new Uint8Array(data.buffer ?? data, data.byteOffset ?? 0, data.byteLength);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

class Table {
  static async open(packed) {
    const [layouts, planes] = await Promise.all([packed.layouts, packed.words].map(inflate));
    return new Table(packed, JSON.parse(new TextDecoder().decode(layouts)), planes);
  }

  constructor(packed, layouts, planes) {
    Object.assign(this, packed, { layouts });
    const total = planes.length / 4, words = new Uint32Array(total);
    let at = 0;
    this.frames = this.sizes.map((size, k) => {  // each frame is a difference to the one before
      const before = this.sizes[k - 1] === size ? at - size : -1, first = at;
      for (let i = 0; i < size; i++, at++) {
        words[at] = planes[at] + (planes[total + at] << 8) + (planes[2 * total + at] << 16)
          + (planes[3 * total + at] << 24) + (before < 0 ? 0 : words[before + i]);
      }
      return new Float32Array(words.buffer, 4 * first, size);
    });
  }

  // Position in the table of the controls' indices, of which number `moved` has just moved.
  position(indices, moved) {
    if (this.full) return indices.reduce((sum, index, k) => sum * this.counts[k] + index, 0);
    return this.counts.slice(0, moved).reduce((a, b) => a + b, 0) + indices[moved];
  }

  frame(position) {
    return { ...this.layouts[position], serial: position + 1, data: this.frames[position] };
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
