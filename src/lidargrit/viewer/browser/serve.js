// The page of the server: a form whose results appear beside one another.

const PANES_AT_MOST = 4; // more are too small to see anything in
const ASK_AGAIN_MS = 300;
const el = (id) => document.getElementById(id);

// A pane whose files the server writes, by the same code as `lidargrit export`.
class ServedPane extends Pane {
  constructor(source, page, job, group, scales) {
    super(source, page);
    this.scales = scales;
    for (const kind of ["npz", "ply", "bin"]) {
      this.part[kind].setAttribute("aria-label", `Save ${source.name} as .${kind}`);
    }
    this.part.npz.addEventListener("click", () => this.save("npz"));
    this.part.remove.setAttribute("aria-label", `Remove ${source.name}`);
    this.part.remove.addEventListener("click", () => desk.arrange(page.panes.filter((one) => one !== this)));
    this.path = `/jobs/${job}/${group}`;
    this.frame = Object.assign(document.createElement("div"), { className: "region", hidden: true });
    this.part.image.after(this.frame);
    this.part.image.addEventListener("pointerdown", (event) => this.beginRegion(event));
    this.part.image.addEventListener("pointermove", (event) => this.stretch(event));
  }

  // Where the pointer is, as shares of the image's width and height.
  at(event) {
    const box = this.part.image.getBoundingClientRect();
    const share = (value) => Math.min(1, Math.max(0, value));
    return [share((event.clientX - box.left) / box.width), share((event.clientY - box.top) / box.height)];
  }

  beginRegion(event) {
    if (desk.draws) {
      event.preventDefault();
      this.part.image.setPointerCapture(event.pointerId);
      this.corner = this.at(event);
    }
  }

  stretch(event) {
    if (!desk.draws || !this.corner || !event.buttons) {
      return;
    }
    const [corner, other] = [this.corner, this.at(event)];
    const [low, high] = [Math.min, Math.max].map((end) => [0, 1].map((axis) => end(corner[axis], other[axis])));
    desk.chooseRegion(low[0] < high[0] && low[1] < high[1] ? [...low, ...high] : null);
  }

  showRegion(region) {
    this.frame.hidden = region === null;
    if (region) {
      const [left, top, right, bottom] = region.map((share) => 100 * share);
      Object.assign(this.frame.style, { left: `${left}%`, top: `${top}%`, width: `${right - left}%`, height: `${bottom - top}%` });
    }
  }

  async save(ending) {
    await desk.trying(async () => {
      const index = this.source.scanIndex(this.page.index);
      const file = await asked(`${this.path}-${index}.${ending}`);
      save([await file.arrayBuffer()], `${this.source.name}-${this.scan.name}.${ending}`);
    });
  }
}

// The answer to a request; a refusal is thrown as an error with the server's words.
async function asked(path, options) {
  let answer;
  try {
    answer = await fetch(path, options);
  } catch {
    throw new Error("The server does not answer. Is it still running?");
  }
  if (!answer.ok) {
    const data = await answer.json().catch(() => ({}));
    throw new Error(data.error ?? (answer.status === 413 ? "The file is too large." : `The server answered ${answer.status}.`));
  }
  return answer;
}

class Desk {
  constructor({ models, limits }) {
    this.models = models;
    this.limits = limits;
    el("model").replaceChildren(...models.map((model, index) => new Option(model.name, String(index))));
    el("count").max = String(limits.scans);
    el("model").addEventListener("change", () => this.offer());
    el("request").addEventListener("submit", (event) => this.submit(event, () => this.generate()));
    el("settings").addEventListener("invalid", () => (el("more").open = true), { capture: true }); // what is wrong is to be seen
    el("own").addEventListener("submit", (event) => {
      event.preventDefault();
      this.workOn(event.submitter.value);
    });
    el("file").addEventListener("change", () => this.chooseExample(""));
    for (const button of el("examples").children) {
      button.addEventListener("click", () => {
        this.chooseExample(button.dataset.example);
        this.workOn(button.dataset.task);
      });
    }
    this.example = "";
    this.task = "";
    this.region = null;
    this.offer();
  }

  // The page begins with a scan that turns, until somebody takes hold of it.
  async begin() {
    await this.submit(null, () => this.generate(1));
    this.page?.turn();
  }

  chooseExample(name) {
    this.example = name;
    if (name) {
      el("file").value = "";
    }
    for (const button of el("examples").children) {
      button.setAttribute("aria-pressed", String(button.dataset.example === name));
    }
    this.chooseRegion(null);
  }

  // Another task than before begins without the region that was drawn for it.
  workOn(task) {
    if (task !== this.task) {
      this.task = task;
      this.chooseRegion(null);
    }
    return this.submit(null, () => this.complete());
  }

  get model() {
    return this.models[Number(el("model").value)];
  }

  // Show what the chosen model can do, and the numbers that it lets the user set.
  offer() {
    const { generator, sensor, settings, upload, tasks } = this.model;
    el("sensor").textContent = `${generator}; ${sensor}`;
    const [first, ...others] = settings.map(fieldOf); // each generator's own order: what matters most comes first
    el("first").replaceChildren(...(first ? [first] : []));
    el("settings").replaceChildren(...others);
    el("more").hidden = others.length === 0;
    this.buttonWords ??= Object.fromEntries([...el("tasks").children].map((one) => [one.value, one.textContent]));
    for (const button of el("tasks").children) {
      button.hidden = upload === "complete" ? !tasks.includes(button.value) : upload === "" || button.value !== "ahead";
      button.textContent = upload === "encode" ? "Reconstruct it" : this.buttonWords[button.value];
    }
    for (const button of el("examples").children) {
      button.hidden = upload === "complete" ? !tasks.includes(button.dataset.task) : upload === "" || button.dataset.example !== "street";
    }
    el("file").disabled = upload === "";
    el("ability").textContent = {
      complete: "All else stays as it is. Measured points are grey, filled ones have a colour.",
      encode: "The model encodes the scan as tokens and decodes a scan from them: you see what the tokens keep.",
    }[upload] ?? `A ${generator} model can neither complete nor reconstruct scans.`;
    this.enable();
  }

  // Whether dragging over a range image draws a region.
  get draws() {
    return this.model.upload === "complete" && this.task === "region";
  }

  chooseRegion(region) {
    this.region = region;
    this.page?.panes.forEach((pane) => pane.showRegion(region));
  }

  enable() {
    for (const button of [el("generate"), ...el("tasks").children, ...el("examples").children]) {
      button.disabled = Boolean(this.busy);
    }
  }

  // The settings that the user typed. The generator chooses the others: it may complete by other values than it
  // samples by, which are those that empty fields show.
  request() {
    const fields = [...el("request").querySelectorAll("[name]")].filter((field) => field.value !== "");
    const data = fields.map((field) => [field.name, Number(field.value)]);
    return { model: Number(el("model").value), seed: Number(el("seed").value), sampling: Object.fromEntries(data) };
  }

  generate(count = Number(el("count").value)) {
    const request = { ...this.request(), count };
    return asked("/generate", { method: "POST", body: JSON.stringify(request) });
  }

  async complete() {
    const [file] = el("file").files;
    const request = { ...this.request(), task: this.task };
    if (this.draws && this.region) {
      request.region = this.region.map((share) => Number(share.toFixed(4)));
    }
    if (this.example) {
      return this.send({ ...request, example: this.example }, "");
    }
    if (!file) {
      throw new Error("Choose a file, or an example, first.");
    }
    if (file.size > this.limits.uploadBytes) {
      throw new Error(`The file has ${file.size.toLocaleString("en")} bytes; at most ${this.limits.uploadBytes.toLocaleString("en")} are taken.`);
    }
    let body;
    try {
      body = await file.arrayBuffer(); // else fetch fails as it does for a server that has ended
    } catch {
      throw new Error(`${file.name} has changed since you chose it, or can no longer be read. Choose it again.`);
    }
    return this.send({ ...request, name: file.name }, body);
  }

  send(request, body) {
    return asked(`/complete?request=${encodeURIComponent(JSON.stringify(request))}`, { method: "POST", body });
  }

  async submit(event, begin) {
    event?.preventDefault();
    if (!el("request").reportValidity()) {
      return; // a scan is worked on by these settings too
    }
    this.busy = true;
    this.enable();
    const changed = Object.entries(this.request().sampling).map(([name, value]) => `${name}=${value}`);
    const by = [this.model.name, ...changed].join(", ");
    await this.trying(async () => {
      const { job } = await (await begin()).json();
      const seconds = await this.waited(job);
      const data = await (await asked(`/jobs/${job}/scans`)).json();
      await this.show(data, job, by);
      const draw = this.draws && !this.region && data.sources.length === 1;
      el("status").textContent = draw ? "Now drag over the part of the range image that is to be filled in, and press the same button again." : `Done in ${seconds} s.`;
    });
    this.busy = false;
    this.enable();
  }

  // Every error is shown in one place.
  async trying(action) {
    el("error").hidden = true;
    try {
      await action();
    } catch (error) {
      el("status").textContent = "";
      el("error").textContent = error.message;
      el("error").hidden = false;
      el("error").scrollIntoView({ block: "nearest" });
    }
  }

  async waited(job) {
    for (;;) {
      const { state, before, seconds, error } = await (await asked(`/jobs/${job}`)).json();
      if (state === "done") {
        return seconds;
      }
      if (state === "failed") {
        throw new Error(error);
      }
      el("status").textContent = state === "waiting" ? `Waiting; requests before yours: ${before}` : `Computing, ${Math.round(seconds)} s`;
      await new Promise((done) => setTimeout(done, seconds < 5 ? ASK_AGAIN_MS : 4 * ASK_AGAIN_MS));
    }
  }

  async show(data, job, by) {
    el("empty").hidden = true;
    el("viewer").hidden = false;
    this.page ??= new Page({ ...data, sources: [] });
    const fresh = data.sources.map((source, group) => {
      const name = {
        generated: by,
        completed: `completed by ${by}`,
        "with raydrop": `raydrop by ${by}`,
        reconstructed: `reconstructed by ${by}`,
        labelled: `labelled by ${by}`,
      }[source.name];
      const shown = Object.assign(new Source(source), { name: name ?? source.name });
      return new ServedPane(shown, this.page, job, group, data.scales);
    });
    const has = (name) => data.sources.some((source) => source.scans.some((scan) => scan[name]));
    if (data.sources.some((source) => source.name === "labelled")) {
      this.page.colourBy("label");
    } else if (this.page.control.mode.value === "label" && !has("label")) {
      this.page.colourBy(has("filled") ? "filled" : "height"); // by labels, which these lack, all of them were grey
    }
    await this.arrange([...this.page.panes, ...fresh].slice(-Math.max(PANES_AT_MOST, fresh.length)));
    fresh.at(-1).element.scrollIntoView({ block: "nearest" }); // on a small screen the form lies below
  }

  // One scale of each colour for all panes, wide enough for every scan.
  async arrange(panes) {
    this.page.arrange(panes);
    if (panes.length === 0) {
      [el("empty").hidden, el("viewer").hidden] = [false, true];
      el("empty").textContent = "Generate a scan, or choose one to work on.";
      return;
    }
    for (const mode of Object.keys(panes[0].scales)) {
      const ends = panes.map((pane) => pane.scales[mode]);
      this.page.data.scales[mode] = [Math.min(...ends.map((end) => end[0])), Math.max(...ends.map((end) => end[1]))];
    }
    await this.page.go(this.page.index);
    this.chooseRegion(this.region);
  }
}

function fieldOf(setting) {
  const [label, input, about] = ["label", "input", "small"].map((kind) => document.createElement(kind));
  label.className = "field";
  Object.assign(input, { type: "number", name: setting.name, step: setting.whole ? "1" : "any", max: String(setting.at_most) });
  if (setting.whole) {
    input.min = "0";
  }
  input.placeholder = setting.default === null ? "" : String(setting.default);
  about.textContent = setting.about.split(/[.;] /)[0].replace(/\.$/, "");
  input.title = setting.about;
  label.append(setting.name.replaceAll("_", " "), input, about);
  return label;
}

let desk = null;
asked("/models")
  .then((answer) => answer.json())
  .then((data) => {
    desk = new Desk(data);
    return desk.begin();
  })
  .catch((error) => {
    el("error").textContent = error.message;
    el("error").hidden = false;
  });
