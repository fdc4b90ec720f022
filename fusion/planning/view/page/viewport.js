/* The visible part of each camera's image: zoom, pan, contrast. Coordinates are pixels; whole numbers are pixel centres. */
"use strict";
(() => {
  const FARTHEST = 64; // zoom
  const STEP = 1.25; // of the zoom by a key or a notch of the wheel
  const SHARE = 0.01; // of the pixels that auto contrast shows black, and white
  const DRAGGED = 4; // px on the screen from which a press is a drag

  /* A viewport draws on its canvas; `drawn` is called whenever its image has to be drawn anew. */
  class Viewport {
    constructor(side, drawn) {
      [this.side, this.drawn, this.canvas] = [side, drawn, view.get(side)];
      [this.zoom, this.x, this.y] = [1, 0, 0];
      [this.width, this.height, this.image, this.shade] = [1, 1, null, null];
      this.sheet = document.createElement("canvas");
      this.controls();
      this.listen();
    }

    /* Size of the pair's images: the canvas has their shape, and the whole image is visible. */
    opened([width, height], full) {
      [this.width, this.height, this.image, this.shade, this.full] = [width, height, null, null, full];
      this.canvas.style.aspectRatio = `${width} / ${height}`;
      for (const input of [this.black, this.white]) input.max = full;
      this.whole();
    }

    whole() { [this.zoom, this.x, this.y] = [1, 0, 0]; }

    /* Image pixels per canvas pixel; canvas pixels are those of the screen. */
    get scale() { return this.width / (this.canvas.width * this.zoom); }

    /* The pixel under a mouse. */
    at(event) {
      const box = this.canvas.getBoundingClientRect();
      const part = this.width / this.zoom;
      return [this.x + ((event.clientX - box.left) / box.width) * part - 0.5, this.y + ((event.clientY - box.top) / box.width) * part - 0.5];
    }

    zoomBy(factor, [x, y] = [this.x + this.width / this.zoom / 2 - 0.5, this.y + this.height / this.zoom / 2 - 0.5]) {
      const before = this.zoom;
      this.zoom = Math.min(FARTHEST, Math.max(1, this.zoom * factor));
      this.x = x + 0.5 - ((x + 0.5 - this.x) * before) / this.zoom;
      this.y = y + 0.5 - ((y + 0.5 - this.y) * before) / this.zoom;
      this.moveBy(0, 0);
    }

    moveBy(dx, dy) {
      const inside = (value, size) => Math.min(size - size / this.zoom, Math.max(0, value));
      [this.x, this.y] = [inside(this.x + dx, this.width), inside(this.y + dy, this.height)];
      this.drawn();
    }

    /* Contrast. */
    controls() {
      const range = (text, changed) => {
        const input = view.element("input", "", { type: "range", min: 0, step: 1 }), shown = document.createElement("output");
        const label = view.element("label", text);
        label.append(input, shown);
        input.addEventListener("input", () => { changed(); this.drawn(); });
        return [label, input, shown];
      };
      const [black, white] = [
        range("black", () => { this.white.value = Math.max(this.white.value, Number(this.black.value) + 1); this.levels(); }),
        range("white", () => { this.black.value = Math.min(this.black.value, Number(this.white.value) - 1); this.levels(); }),
      ];
      [this.black, this.blackShown, this.white, this.whiteShown] = [black[1], black[2], white[1], white[2]];
      const auto = view.element("button", "auto contrast", { type: "button", title: "black: 1 %, white: 99 % of the pixels of this image",
        onclick: () => { this.auto(); this.drawn(); } });
      view.get(`${this.side}-contrast`).replaceChildren(black[0], white[0], auto);
    }

    levels() {
      [this.blackShown.value, this.whiteShown.value, this.shade] = [this.black.value, this.white.value, null];
    }

    auto() {
      if (!this.image) return;
      const { grey } = this.image, count = new Uint32Array(grey.BYTES_PER_ELEMENT === 1 ? 256 : 65536);
      for (let i = 0; i < grey.length; i += 1) count[grey[i]] += 1;
      const quantile = (share) => {
        let sum = 0, level = 0;
        while (level < count.length - 1 && sum + count[level] <= share * grey.length) sum += count[level++];
        return level;
      };
      [this.black.value, this.white.value] = [quantile(SHARE), Math.max(quantile(1 - SHARE), quantile(SHARE) + 1)];
      this.levels();
    }

    /* Show an image, or null for none; the first one of a series sets the contrast. */
    show(image) {
      const first = !this.image && image && !this.shadeKept;
      [this.image, this.shade] = [image, null];
      if (first) {
        this.auto();
        this.shadeKept = true;
      }
    }

    /* Grey values to shades, once for each image and contrast. */
    shaded() {
      if (this.shade || !this.image) return;
      const { grey, width, height } = this.image, low = Number(this.black.value), span = Math.max(1, this.white.value - low);
      const shades = new Uint32Array(grey.BYTES_PER_ELEMENT === 1 ? 256 : 65536);
      for (let i = 0; i < shades.length; i += 1) {
        shades[i] = 0xff000000 | (Math.round(Math.min(255, Math.max(0, ((i - low) * 255) / span))) * 0x010101);
      }
      const pixels = new ImageData(width, height), words = new Uint32Array(pixels.data.buffer);
      for (let i = 0; i < grey.length; i += 1) words[i] = shades[grey[i]];
      if (this.sheet.width !== width || this.sheet.height !== height) [this.sheet.width, this.sheet.height] = [width, height];
      this.sheet.getContext("2d").putImageData(pixels, 0, 0);
      this.shade = true;
    }

    /* Draw the image, and let `marks` draw on it in pixels of the image: (pen, image pixels per screen pixel). */
    paint(marks) {
      const { canvas } = this, sharp = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
      const [width, height] = [Math.max(1, Math.round(box.width * sharp)), Math.max(1, Math.round(box.height * sharp))];
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      const pen = canvas.getContext("2d");
      pen.setTransform(1, 0, 0, 1, 0, 0);
      pen.clearRect(0, 0, width, height);
      pen.setTransform(1 / this.scale, 0, 0, 1 / this.scale, -this.x / this.scale, -this.y / this.scale);
      pen.imageSmoothingEnabled = this.scale > 0.5;
      if (this.image) {
        this.shaded();
        pen.drawImage(this.sheet, 0, 0);
      } else {
        pen.fillStyle = "#bbb";
        pen.font = `${16 * sharp * this.scale}px system-ui, sans-serif`;
        pen.textAlign = "center";
        pen.fillText("no image can be shown", this.x + this.width / this.zoom / 2, this.y + this.height / this.zoom / 2);
      }
      marks(pen, this.scale * sharp);
    }

    /* Wheel, keys, drags, double click. `view.drawing` is true while the mouse draws an outline on this canvas. */
    listen() {
      const { canvas } = this, pointers = new Map();
      let from = null;
      canvas.tabIndex = 0;
      canvas.addEventListener("wheel", (event) => {
        event.preventDefault();
        this.zoomBy(STEP ** (-Math.sign(event.deltaY) * Math.min(1, Math.abs(event.deltaY) / 50)), this.at(event));
      }, { passive: false });
      canvas.addEventListener("pointerdown", (event) => {
        pointers.set(event.pointerId, event);
        if (event.button === 1 || event.shiftKey || !view.drawing?.(this.side)) {
          from = { x: event.clientX, y: event.clientY, moved: false };
          canvas.setPointerCapture(event.pointerId);
        }
        this.dragged = false;
      });
      canvas.addEventListener("pointermove", (event) => {
        this.under = this.at(event);
        const before = pointers.get(event.pointerId);
        if (!before) return;
        pointers.set(event.pointerId, event);
        const [one, two] = [...pointers.values()], other = one === event ? two : one;
        const part = this.width / this.zoom / canvas.getBoundingClientRect().width;
        if (other) { // two fingers
          const far = (a) => Math.hypot(a.clientX - other.clientX, a.clientY - other.clientY);
          this.dragged = true;
          this.zoomBy(far(event) / Math.max(1, far(before)), this.at({ clientX: (event.clientX + other.clientX) / 2, clientY: (event.clientY + other.clientY) / 2 }));
        } else if (from && (from.moved || Math.hypot(event.clientX - from.x, event.clientY - from.y) >= DRAGGED)) {
          from.moved = this.dragged = true;
          this.moveBy((before.clientX - event.clientX) * part, (before.clientY - event.clientY) * part);
        }
      });
      for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
        canvas.addEventListener(end, (event) => { pointers.delete(event.pointerId); from = null; });
      }
      canvas.addEventListener("pointerleave", () => { this.under = undefined; });
      canvas.addEventListener("dblclick", () => {
        if (view.drawing?.(this.side)) return;
        this.whole();
        this.drawn();
      });
    }
  }
  view.Viewport = Viewport;
  view.ZOOM_STEP = STEP;
})();
