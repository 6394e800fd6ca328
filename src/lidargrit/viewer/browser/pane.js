// One source on the page: its points, its range image beneath, and what lies under the pointer.

class Pane {
  constructor(source, page) {
    this.source = source;
    this.page = page;
    this.element = document.getElementById("pane").content.firstElementChild.cloneNode(true);
    this.part = Object.fromEntries(
      [...this.element.querySelectorAll("[data-part]")].map((part) => [part.dataset.part, part]),
    );
    this.part.name.textContent = source.name;
    this.part.cloud.setAttribute("aria-label", `Points of ${source.name}. Turn with W, A, S and D, zoom with + and -.`);
    this.part.image.setAttribute("aria-label", `Range image of ${source.name}. Shift and arrows move the mark.`);
    this.part.image.width = source.width;
    this.part.image.height = source.height;
    this.drawer = drawerFor(this.part.cloud);
    this.listen();
  }

  listen() {
    const { cloud, image, bin, ply } = this.part;
    bin.addEventListener("click", () => this.save("bin", binFile));
    ply.addEventListener("click", () => this.save("ply", plyFile));
    image.addEventListener("pointermove", (event) => this.page.mark(this, this.pixelAt(event)));
    image.addEventListener("pointerleave", () => this.page.mark(this, -1));
    image.addEventListener("keydown", (event) => this.walk(event));
    cloud.addEventListener("pointerleave", () => this.page.mark(this, -1));
    cloud.addEventListener("redraw", () => this.page.redraw());
    cloud.addEventListener("pointerdown", (event) => cloud.setPointerCapture(event.pointerId));
    cloud.addEventListener("pointermove", (event) => (event.buttons ? this.drag(event) : this.find(event)));
    cloud.addEventListener("contextmenu", (event) => event.preventDefault());
    cloud.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.page.camera.zoom(Math.exp(Math.sign(event.deltaY) * Math.min(0.3, Math.abs(event.deltaY) / 600)));
        this.page.redraw();
      },
      { passive: false },
    );
  }

  drag(event) {
    const { camera } = this.page;
    const height = this.part.cloud.clientHeight;
    if (event.shiftKey || event.buttons > 1) {
      camera.pan(-event.movementX / height, event.movementY / height);
    } else {
      camera.orbit(-event.movementX * 0.006, event.movementY * 0.006);
    }
    this.page.redraw();
  }

  // The search goes over all points: once a frame is enough.
  find(event) {
    if (!this.points) {
      return;
    }
    const [left, top] = [event.offsetX, event.offsetY];
    cancelAnimationFrame(this.search);
    this.search = requestAnimationFrame(() => {
      const { clientWidth, clientHeight } = this.part.cloud;
      const matrix = this.page.camera.matrix(clientWidth / clientHeight);
      this.page.mark(this, pick(matrix, this.points, this.page.withDropped, clientWidth, clientHeight, left, top));
    });
  }

  pixelAt(event) {
    const { clientWidth, clientHeight } = this.part.image;
    const column = Math.floor((event.offsetX / clientWidth) * this.source.width);
    const row = Math.floor((event.offsetY / clientHeight) * this.source.height);
    const inside = column >= 0 && row >= 0 && column < this.source.width && row < this.source.height;
    return inside ? row * this.source.width + column : -1;
  }

  walk(event) {
    const steps = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -this.source.width, ArrowDown: this.source.width };
    if (!event.shiftKey || !(event.key in steps)) {
      return;
    }
    event.preventDefault();
    event.stopPropagation();
    const from = this.marked >= 0 && this.marked < this.source.size ? this.marked : Math.floor((this.source.height / 2 + 0.5) * this.source.width);
    this.page.mark(this, Math.min(this.source.size - 1, Math.max(0, from + steps[event.key])));
  }

  async show(index) {
    const scan = await this.source.scan(index);
    if (this.page.index !== index) {
      return; // somebody has stepped on meanwhile
    }
    this.scan = scan;
    this.marked = this.marked < this.source.size ? this.marked : -1; // another scan has other points without a pixel
    this.points = pointsOf(this.source, this.scan);
    this.fresh = true; // points and colours are rendered together, once all panes have theirs
    const number = this.source.scanIndex(index) + 1;
    this.part.about.textContent = `${scan.name} (${number} of ${this.source.count}): ${this.counted(scan)}`;
  }

  // All points in words, and those that are not shown.
  counted(scan) {
    const words = (count) => count.toLocaleString("en");
    const [beside, share] = [scan.beside.length / 3, Math.round((100 * scan.returns) / this.source.size)];
    const filled = scan.filled?.reduce((sum, one) => sum + one, 0);
    const parts = [`${words(scan.returns + beside)} points, from ${share} % of rays${this.source.columns}`];
    if (filled !== undefined) {
      parts.push(`${words(scan.returns + beside - filled)} were measured and ${words(filled)} filled in by a model`);
    }
    if (beside) {
      parts.push(`${words(beside)} of all have no pixel of their own below`);
    }
    if (scan.hidden) {
      parts.push(`${words(scan.hidden)} more are hidden, since each pixel shows one point`);
    }
    return parts.join("; ");
  }

  paint(look) {
    const colours = coloursOf(this.source, this.scan, this.points, look);
    if (this.fresh) {
      this.drawer.setPoints(this.points);
      this.fresh = false;
    }
    this.painted = true;
    this.drawer.setColours(colours);
    const pixels = colours.subarray(0, 4 * this.source.size);
    const picture = new ImageData(pixels, this.source.width, this.source.height);
    this.part.image.getContext("2d").putImageData(picture, 0, 0);
    const missing = ["reflectance", "anomaly", "label"].includes(look.mode) && !this.scan[look.mode];
    this.part.missing.textContent = missing ? `No ${look.mode} is known here.` : "";
  }

  draw() {
    const { cloud } = this.part;
    const dense = window.devicePixelRatio || 1;
    const [width, height] = [Math.round(cloud.clientWidth * dense), Math.round(cloud.clientHeight * dense)];
    if (width === 0 || height === 0) {
      return; // not laid out yet, or hidden
    }
    if (cloud.width !== width || cloud.height !== height) {
      [cloud.width, cloud.height] = [width, height];
    }
    this.drawer.draw(this.page.camera.matrix(width / height), this.page.pointSize * dense, this.page.withDropped);
    this.moveMarks();
  }

  close() {
    this.element.remove();
    this.drawer.close();
  }

  // Point at a pixel in both pictures, and say what it is; -1 for none.
  mark(pixel) {
    if (!this.points) {
      return; // nothing is shown yet
    }
    this.marked = pixel;
    this.moveMarks();
    this.part.readout.textContent = pixel < 0 ? "" : this.describe(pixel);
  }

  moveMarks() {
    const { cloud, image, cloudMark, imageMark } = this.part;
    const pixel = this.marked;
    const matrix = this.page.camera.matrix(cloud.clientWidth / cloud.clientHeight);
    const seen = pixel < 0 ? null : onScreen(matrix, this.points, pixel, cloud.clientWidth, cloud.clientHeight);
    const inside = seen && seen[0] > 0 && seen[1] > 0 && seen[0] < cloud.clientWidth && seen[1] < cloud.clientHeight;
    cloudMark.hidden = !inside || (!this.page.withDropped && !isReturn(this.source, this.scan, pixel));
    imageMark.hidden = pixel < 0 || pixel >= this.source.size;
    if (inside) {
      cloudMark.style.transform = `translate(${seen[0]}px, ${seen[1]}px)`;
    }
    if (!imageMark.hidden) {
      const across = (((pixel % this.source.width) + 0.5) / this.source.width) * image.clientWidth;
      const down = ((Math.floor(pixel / this.source.width) + 0.5) / this.source.height) * image.clientHeight;
      imageMark.style.transform = `translate(${across}px, ${down}px)`;
    }
  }

  // The position comes last: it is what may be cut off where panes are narrow.
  describe(pixel) {
    const { source, scan } = this;
    const returned = isReturn(source, scan, pixel);
    const facts = scan.label && returned ? [source.classes[scan.label[pixel]].name] : [];
    if (!returned) {
      facts.push("no return");
    } else {
      facts.push(`${rangeM(source, scan, pixel).toFixed(2)} m away`, `height ${this.points[4 * pixel + 2].toFixed(2)} m`);
    }
    if (scan.filled?.[pixel]) {
      facts.push("filled by a model");
    }
    if (scan.reflectance && returned) {
      facts.push(`reflectance ${(scan.reflectance[pixel] / 255).toFixed(2)}`);
    }
    if (scan.anomaly && returned) {
      const share = scan.anomaly[pixel] / 255;
      facts.push(`anomaly ${(share * this.page.data.scales.anomaly[1]).toFixed(1)} bits${share === 1 ? " or more" : ""}`);
    }
    const place = `row ${Math.floor(pixel / source.width)}, column ${pixel % source.width}`;
    return `${facts.join(", ")} (${pixel < source.size ? place : "no pixel of its own"})`;
  }

  save(ending, write) {
    const parts = write(this.source, this.scan, this.points);
    save(parts, `${this.source.name}-${this.scan.name}.${ending}`);
  }
}
