// The whole page: controls, keys, and the panes that follow them.

const TURN_A_FRAME = 0.004; // a turn in half a minute
const LONGEST_MS = 1000; // that a scan of a drive is shown before the next one, as at the end of the drive
const DENSE = 50000; // pixels of a scan whose points would cover one another if they were as large as those of others

let touched = false; // whether somebody has taken hold of anything on the page
for (const kind of ["pointerdown", "keydown", "wheel"]) {
  window.addEventListener(kind, () => (touched = true), { once: true, capture: true });
}

class Page {
  constructor(data) {
    this.data = data;
    this.camera = new Camera(data.reachM);
    this.control = Object.fromEntries(
      ["previous", "next", "play", "position", "counter", "mode", "dropped", "size", "light", "reset", "legend"].map((id) => [
        id,
        document.getElementById(id),
      ]),
    );
    this.panes = [];
    this.index = 0;
    this.area = document.getElementById("panes");
    document.getElementById("slow").hidden = hasGraphicsCard();
    this.arrange(data.sources.map((source) => new Pane(new Source(source), this)));
    this.listen();
  }

  get withDropped() {
    return this.control.dropped.checked;
  }

  get pointSize() {
    return Number(this.control.size.value);
  }

  // Show these panes and no others, in this order.
  arrange(panes) {
    this.panes.filter((pane) => !panes.includes(pane)).forEach((pane) => pane.close());
    panes.filter((pane) => !this.panes.includes(pane)).forEach((pane) => this.area.append(pane.element));
    this.panes = panes;
    if (!this.sizeChosen) {
      const most = Math.max(0, ...panes.map((pane) => pane.source.size));
      this.control.size.value = most > DENSE ? "1.5" : "3";
    }
    this.count = Math.max(1, ...panes.map((pane) => pane.source.count));
    this.index = Math.min(this.index, this.count - 1);
    this.offerModes();
  }

  // Only what some scan has.
  offerModes() {
    const has = (name) => this.panes.some((pane) => pane.source.scans.some((scan) => scan[name]));
    const { mode } = this.control;
    for (const name of ["reflectance", "anomaly", "label", "filled"]) {
      mode.querySelector(`[value=${name}]`).disabled = !has(name);
    }
    if (mode.selectedOptions[0].disabled) {
      mode.value = "height"; // by what only scans had that are gone, all would be of one colour
      this.chosen = false;
    }
    const offered = ["anomaly", "filled"].find(has);
    if (offered && !this.chosen) {
      this.colourBy(offered);
    }
    this.control.position.max = String(this.count);
    for (const name of ["previous", "next", "position"]) {
      this.control[name].disabled = this.count < 2;
    }
    this.control.play.hidden = !this.times();
  }

  // When each scan of a drive was made; nothing where none of the panes shows one.
  times() {
    const all = this.panes.map((pane) => pane.source.scans.map((scan) => scan.time));
    return all.find((times) => times.length === this.count && this.count > 1 && !times.includes(undefined));
  }

  colourBy(mode) {
    this.chosen = true;
    this.control.mode.value = mode;
  }

  listen() {
    const { previous, next, play, position, mode, dropped, size, light, reset } = this.control;
    previous.addEventListener("click", () => this.step(-1));
    next.addEventListener("click", () => this.step(1));
    play.addEventListener("click", () => this.play(!this.playing));
    position.addEventListener("input", () => {
      this.play(false);
      this.go(Number(position.value) - 1);
    });
    mode.addEventListener("change", () => this.paint());
    dropped.addEventListener("change", () => this.redraw());
    size.addEventListener("input", () => {
      this.sizeChosen = true;
      this.redraw();
    });
    reset.addEventListener("click", () => {
      this.camera.reset();
      this.redraw();
    });
    light.addEventListener("change", () => this.paint());
    window.addEventListener("keydown", (event) => this.press(event));
    new ResizeObserver(() => this.redraw()).observe(this.area);
  }

  press(event) {
    const keys = {
      arrowleft: () => this.step(-1),
      arrowright: () => this.step(1),
      p: () => this.play(!this.playing && !this.control.play.hidden),
      a: () => this.camera.orbit(-0.08, 0),
      d: () => this.camera.orbit(0.08, 0),
      w: () => this.camera.orbit(0, 0.08),
      s: () => this.camera.orbit(0, -0.08),
      "+": () => this.camera.zoom(0.87),
      "=": () => this.camera.zoom(0.87), // the same key without Shift
      "-": () => this.camera.zoom(1.15),
      0: () => this.camera.reset(),
    };
    // Sliders, lists and fields have these keys for themselves, and the browser has those with Ctrl.
    const own = event.target.matches?.("input:not([type=checkbox]), select, textarea");
    const taken = own || event.ctrlKey || event.metaKey || event.altKey;
    const key = event.key?.toLowerCase(); // Caps Lock may be on, and a field that fills itself in presses none
    if (!taken && key in keys) {
      event.preventDefault();
      keys[key]();
      this.redraw();
    }
  }

  // Turn by itself, until somebody takes hold of anything.
  turn() {
    const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    const next = () => {
      if (!still && !touched && this.panes.length > 0) {
        this.camera.orbit(TURN_A_FRAME, 0);
        this.redraw();
        requestAnimationFrame(next);
      }
    };
    requestAnimationFrame(next);
  }

  // Round and round: after the last comes the first.
  step(by) {
    this.play(false);
    return this.go((this.index + by + this.count) % this.count);
  }

  // Show the scans of a drive at their own times, or stop.
  async play(on) {
    const turn = on ? {} : null; // another one ends this one
    this.playing = turn;
    this.control.play.textContent = on ? "Pause" : "Play";
    this.control.play.setAttribute("aria-pressed", String(on));
    this.control.counter.setAttribute("aria-live", on ? "off" : "polite"); // ten scans a second are not read out
    for (let due = performance.now(); turn && this.playing === turn; ) {
      const [times, next] = [this.times(), (this.index + 1) % this.count];
      const passed = 1000 * (times?.[next] - times?.[this.index]);
      due = Math.max(due + (passed > 0 ? Math.min(passed, LONGEST_MS) : LONGEST_MS), performance.now());
      await new Promise((done) => setTimeout(done, due - performance.now()));
      if (this.playing === turn) {
        await this.go(next);
      }
    }
  }

  async go(index) {
    this.index = index;
    this.control.position.value = String(index + 1);
    this.control.counter.textContent = `Scan ${index + 1} of ${this.count}`;
    this.area.setAttribute("aria-busy", "true"); // until all pictures are of this scan
    try {
      await Promise.all(this.panes.map((pane) => pane.show(index)));
    } catch (error) {
      document.getElementById("trouble").hidden = false;
      console.warn(error);
    }
    if (this.index === index) {
      this.paint();
      this.panes.forEach((pane) => pane.mark(pane.marked));
      this.area.setAttribute("aria-busy", "false");
    }
  }

  look() {
    const theme = this.control.light.checked ? "light" : "dark";
    this.area.classList.toggle("on-light", this.control.light.checked);
    return {
      ...this.data.looks[theme],
      classes: classesOf(this.panes),
      scales: this.data.scales,
      mode: this.control.mode.value,
    };
  }

  paint() {
    const look = this.look();
    this.panes.filter((pane) => pane.points).forEach((pane) => pane.paint(look));
    this.control.legend.replaceChildren(...legendOf(look));
    this.redraw();
  }

  redraw() {
    this.waiting ??= requestAnimationFrame(() => {
      this.waiting = null;
      this.panes.filter((pane) => pane.painted).forEach((pane) => pane.draw());
    });
  }

  // Mark a pixel in every pane that looks along the same rays.
  mark(from, pixel) {
    for (const pane of this.panes) {
      const alike = pane.source.height === from.source.height && pane.source.width === from.source.width;
      pane.mark(pane === from || (alike && pixel < pane.source.size) ? pixel : -1);
    }
  }
}

// The classes of all panes, each once: those of a source are indexed from 0, whatever others have.
function classesOf(panes) {
  const classes = panes.flatMap((pane) => pane.source.classes).map((one) => [one.number, one]);
  return [...new Map(classes).values()].sort((one, other) => one.number - other.number);
}

// What the colours mean: a ramp with its ends, or the classes by name.
function legendOf(look) {
  const text = (words) => Object.assign(document.createElement("span"), { textContent: words });
  const css = (colour) => `rgb(${colour.join(" ")})`;
  const chip = (colour, words) => {
    const one = text(words);
    one.className = "chip";
    one.style.setProperty("--chip", colour);
    return one;
  };
  if (look.mode === "label") {
    // Classes of one colour share a chip.
    const names = new Map();
    for (const one of look.classes) {
      names.set(css(one.colour), [...(names.get(css(one.colour)) ?? []), one.name]);
    }
    const chips = [...names].map(([colour, together]) => chip(colour, together.join(", ")));
    return [...chips, chip(css(look.noReturn), "no return")];
  }
  if (look.mode === "filled") {
    const chips = [[look.measured, "measured"], [look.filled, "filled by a model"], [look.noReturn, "no return"]];
    return chips.map(([colour, words]) => chip(css(colour), words));
  }
  const ramp = document.createElement("span");
  ramp.className = "ramp";
  ramp.style.backgroundImage = `linear-gradient(to right, ${look.ramps[look.mode].map(css).join(",")})`;
  const [low, high] = look.scales[look.mode].map((value) => Number(value.toFixed(1)));
  const ends = {
    range: [`${low} m`, `${high} m away`],
    height: [`${low} m`, `${high} m above the sensor`],
    reflectance: ["weak, 0", "1, strong"],
    anomaly: ["as expected or less", `${high} bits more than expected, or beyond`],
    ring: ["top row", "bottom row"],
  }[look.mode];
  return [text(ends[0]), ramp, text(ends[1]), chip(css(look.noReturn), "no return")];
}
