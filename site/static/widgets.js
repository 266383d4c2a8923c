// Plays the course's widgets on a page without a kernel: sliders, lists, check boxes, buttons, boxes
// and our canvas, from the widget state that the executed notebook saved. Nothing is loaded.
(() => {
const STATE = 'script[type="application/vnd.jupyter.widget-state+json"]';
const VIEW = 'script[type="application/vnd.jupyter.widget-view+json"]';

class Model {
  constructor(manager, id, entry) {
    Object.assign(this, { widget_manager: manager, id, name: entry.model_name, values: entry.state, handlers: {} });
    for (const { path, data } of entry.buffers ?? []) {
      const bytes = Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
      const owner = path.slice(0, -1).reduce((value, key) => value[key], this.values);
      owner[path.at(-1)] = new DataView(bytes.buffer);
    }
    this.first = this.values.index === undefined ? ["value", this.values.value] : ["index", this.values.index];
  }
  get(name) { return this.values[name]; }
  set(name, value) {
    if (this.values[name] === value) return;
    this.values[name] = value;
    for (const call of this.handlers["change:" + name] ?? []) call();
  }
  on(names, call) { for (const name of names.split(" ")) (this.handlers[name] ??= []).push(call); }
  off(name, call) { this.handlers[name] = (this.handlers[name] ?? []).filter((c) => c !== call); }
  save_changes() {}
}

class Manager {
  constructor(states) {
    this.models = new Map(Object.entries(states).map(([id, entry]) => [id, new Model(this, id, entry)]));
    this.modules = new Map();
    this.started = new Map();
  }
  async get_model(id) { return this.models.get(id.replace("IPY_MODEL_", "")); }
  // One module for each script text; `initialize` runs once a model.
  async module(model) {
    const text = model.get("_esm");
    if (!this.modules.has(text)) {
      const file = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
      this.modules.set(text, import(file).then((found) => found.default));
      const style = document.createElement("style");
      style.textContent = model.get("_css") ?? "";
      document.head.appendChild(style);
    }
    const module = await this.modules.get(text);
    if (!this.started.has(model.id)) this.started.set(model.id, module.initialize?.({ model }));
    await this.started.get(model.id);
    return module;
  }
}

const make = (kind, parent, properties = {}) =>
  parent.appendChild(Object.assign(document.createElement(kind), properties));

function labelled(model, box, control) {
  const label = make("label", box, { className: "cmc-control" });
  make("span", label, { textContent: model.get("description") ?? "" });
  label.appendChild(control);
  control.setAttribute("aria-label", model.get("description") || "control");
  return label;
}

const draw = {
  async Box(model, el, manager) {
    const box = make("div", el, { className: model.name === "VBoxModel" ? "cmc-column" : "cmc-row" });
    for (const child of model.get("children")) await show(await manager.get_model(child), box, manager);
  },
  Slider(model, el) {
    const control = document.createElement("input"), step = model.get("step");
    Object.assign(control, { type: "range", min: model.get("min"), max: model.get("max"), step: step ?? "any" });
    control.value = model.get("value");
    const label = labelled(model, el, control), out = make("output", label);
    const digits = Number((model.get("readout_format") ?? "").match(/\.(\d+)f/)?.[1] ?? 0);
    const print = () => { out.textContent = Number(model.get("value")).toFixed(digits).replace("-", "−"); };
    control.addEventListener("input", () => model.set("value", Number(control.value)));
    model.on("change:value", () => { control.value = model.get("value"); print(); });
    print();
  },
  Dropdown(model, el) {
    const control = document.createElement("select");
    for (const text of model.get("_options_labels")) make("option", control, { textContent: text });
    control.selectedIndex = model.get("index");
    labelled(model, el, control);
    control.addEventListener("change", () => model.set("index", control.selectedIndex));
    model.on("change:index", () => { control.selectedIndex = model.get("index"); });
  },
  Checkbox(model, el) {
    const control = Object.assign(document.createElement("input"), { type: "checkbox", checked: model.get("value") });
    labelled(model, el, control);
    control.addEventListener("change", () => model.set("value", control.checked));
    model.on("change:value", () => { control.checked = model.get("value"); });
  },
  Button(model, el, manager) {
    const button = make("button", el, { textContent: model.get("description"), title: model.get("tooltip") ?? "" });
    button.addEventListener("click", () => {  // the course's only button puts its neighbours back
      for (const other of manager.models.values()) {
        if (other.beside?.has(model.id) && other.first[1] != null) other.set(...other.first);
      }
    });
  },
  HTML(model, el) { make("div", el).innerHTML = model.get("value"); },
  async Any(model, el, manager) {
    const module = await manager.module(model);
    module.render?.({ model, el: make("div", el) });
  },
};
const KINDS = { VBoxModel: "Box", HBoxModel: "Box", BoxModel: "Box", FloatSliderModel: "Slider", IntSliderModel: "Slider",
  DropdownModel: "Dropdown", CheckboxModel: "Checkbox", ButtonModel: "Button", HTMLModel: "HTML", AnyModel: "Any" };

async function show(model, el, manager) {
  const kind = KINDS[model?.name];
  if (!kind) return;  // progress bars of a finished training, for one
  if (kind === "Box") {
    const ids = new Set(model.get("children").map((id) => id.replace("IPY_MODEL_", "")));
    for (const id of ids) manager.models.get(id).beside = ids;
  }
  await draw[kind](model, el, manager);
}

async function start() {
  const states = {};
  for (const script of document.querySelectorAll(STATE)) Object.assign(states, JSON.parse(script.textContent).state);
  const manager = new Manager(states);
  for (const script of document.querySelectorAll(VIEW)) {
    const place = document.createElement("div");
    place.className = "cmc-widget";
    script.before(place);
    await show(await manager.get_model(JSON.parse(script.textContent).model_id), place, manager);
  }
  document.documentElement.dataset.widgets = "ready";
}
if (document.readyState === "loading") addEventListener("DOMContentLoaded", start);
else start();
})();
