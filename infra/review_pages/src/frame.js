// The picture on a Konva stage: wheel zoom at the cursor, marks to drag, the pitch over it.
//
// All places are in pixels of the picture; (0, 0) is the centre of its top-left pixel.

import Konva from "konva/lib/Core.js";
import { Circle } from "konva/lib/shapes/Circle.js";
import { Image as Picture } from "konva/lib/shapes/Image.js";
import { Line } from "konva/lib/shapes/Line.js";
import { Text } from "konva/lib/shapes/Text.js";

export const COLORS = { good: "#4fb3ff", wrong: "#ff8a2a", chosen: "#ffffff", pitch: "#ffd54a" };
const LARGEST = 40; // screen pixels a pixel
const ZOOM = 1.0018; // a notch of a wheel is 120

export class Frame {
  constructor(container, size, events) {
    this.size = size;
    this.events = events;
    this.container = container;
    this.stage = new Konva.Stage({
      container,
      width: container.clientWidth,
      height: container.clientHeight,
    });
    this.picture = new Konva.Layer({ listening: false });
    this.overlay = new Konva.Layer({ listening: false });
    this.marks = new Konva.Layer();
    this.stage.add(this.picture, this.overlay, this.marks);
    this.lines = [];
    this.ghost = null;
    this.residuals = [];
    this.showLines = true;
    this.overlay.add(
      new Konva.Shape({ sceneFunc: (context) => this.#paint(context), perfectDrawEnabled: false }),
    );
    this.#listen();
    this.observer = new ResizeObserver(() => this.#resize());
    this.observer.observe(container);
    // After Konva has told of the end of a drag.
    this.release = () =>
      setTimeout(() => {
        this.held = false;
        if (this.later) this.setMarks(this.later);
        this.later = null;
      });
    window.addEventListener("pointerup", this.release);
    this.fit();
  }

  destroy() {
    window.removeEventListener("pointerup", this.release);
    this.observer.disconnect();
    this.stage.destroy();
  }

  setPicture(image) {
    this.image = image;
    this.picture.destroyChildren();
    this.picture.add(new Picture({ image, x: -0.5, y: -0.5, width: this.size[0], height: this.size[1] }));
    this.#smooth();
  }

  // Where everything is, at once: one path for all markings.
  setPitch(markings, residuals) {
    this.lines = Object.values(markings).flat();
    this.residuals = residuals;
    this.overlay.draw();
  }

  setGhost(place) {
    this.ghost = place;
    this.overlay.batchDraw();
  }

  // While one is held they stay: the held one must not vanish under the hand.
  setMarks(marks) {
    if (this.held) {
      this.later = marks;
      return;
    }
    this.marks.destroyChildren();
    for (const mark of marks) {
      if (mark.line && mark.line.length > 1) {
        this.marks.add(
          new Line({
            points: mark.line.flat(),
            stroke: mark.chosen ? COLORS.chosen : mark.wrong ? COLORS.wrong : COLORS.good,
            strokeWidth: 1.5,
            dash: [6, 5],
            strokeScaleEnabled: false,
            listening: false,
          }),
        );
      }
      for (const [vertex, place] of mark.places.entries()) this.marks.add(this.#mark(mark, vertex, place));
    }
    this.marks.batchDraw();
  }

  fit() {
    const { width, height } = this.#space();
    const scale = Math.min(width / this.size[0], height / this.size[1]);
    this.smallest = scale * 0.8;
    this.#look(scale, [(width - scale * this.size[0]) / 2, (height - scale * this.size[1]) / 2]);
  }

  zoomBy(factor, at = null) {
    const { width, height } = this.#space();
    const center = at ?? [width / 2, height / 2];
    const old = this.stage.scaleX();
    const scale = Math.max(this.smallest, Math.min(LARGEST, old * factor));
    const ratio = scale / old;
    this.#look(scale, [
      center[0] - (center[0] - this.stage.x()) * ratio,
      center[1] - (center[1] - this.stage.y()) * ratio,
    ]);
  }

  // Bring a place to the middle, close enough to click it.
  lookAt(place, scale = Math.max(6, this.stage.scaleX())) {
    const { width, height } = this.#space();
    this.#look(scale, [width / 2 - place[0] * scale, height / 2 - place[1] * scale]);
  }

  isInView(place) {
    const { width, height } = this.#space();
    const x = place[0] * this.stage.scaleX() + this.stage.x();
    const y = place[1] * this.stage.scaleY() + this.stage.y();
    return x > 20 && y > 20 && x < width - 20 && y < height - 20;
  }

  #space() {
    return { width: this.container.clientWidth, height: this.container.clientHeight };
  }

  #resize() {
    const { width, height } = this.#space();
    if (!width || !height) return;
    const whole = this.stage.scaleX() <= this.smallest / 0.8 + 1e-9;
    this.stage.size({ width, height });
    if (whole) this.fit();
  }

  #look(scale, [x, y]) {
    this.stage.scale({ x: scale, y: scale });
    this.stage.position({ x, y });
    for (const node of this.marks.find(".constant")) node.scale({ x: 1 / scale, y: 1 / scale });
    this.#smooth();
    this.stage.batchDraw();
    this.events.looked?.(scale);
  }

  // Single pixels are seen as they are.
  #smooth() {
    this.picture.imageSmoothingEnabled(this.stage.scaleX() < 2);
    this.picture.batchDraw();
  }

  #place() {
    const at = this.stage.getPointerPosition();
    const scale = this.stage.scaleX();
    return [(at.x - this.stage.x()) / scale, (at.y - this.stage.y()) / scale];
  }

  #listen() {
    const { stage } = this;
    stage.on("wheel", ({ evt }) => {
      evt.preventDefault();
      const at = stage.getPointerPosition();
      const step = evt.deltaMode === 1 ? 40 * evt.deltaY : evt.deltaY;
      this.zoomBy(ZOOM ** -step, [at.x, at.y]);
    });
    let from = null;
    stage.on("mousedown touchstart", ({ evt, target }) => {
      if (target.name() === "constant" || target.getParent()?.name() === "constant") return;
      const at = stage.getPointerPosition();
      from = { at, position: stage.position(), moved: false };
      evt.preventDefault();
      this.container.focus?.();
    });
    stage.on("mousemove touchmove", () => {
      const at = stage.getPointerPosition();
      if (from && at) {
        const dx = at.x - from.at.x;
        const dy = at.y - from.at.y;
        if (Math.hypot(dx, dy) > 4) from.moved = true;
        if (from.moved) this.#look(stage.scaleX(), [from.position.x + dx, from.position.y + dy]);
      }
      if (at) this.events.hover?.(this.#place());
    });
    stage.on("mouseup touchend", ({ evt }) => {
      if (from && !from.moved && (evt.button ?? 0) === 0) this.events.click?.(this.#place());
      from = null;
    });
    stage.on("mouseleave", () => {
      from = null;
    });
  }

  #mark(mark, vertex, place) {
    const scale = 1 / this.stage.scaleX();
    const group = new Konva.Group({
      x: place[0],
      y: place[1],
      scaleX: scale,
      scaleY: scale,
      name: "constant",
      draggable: true,
      dragDistance: 3,
    });
    const chosen = mark.chosen && (mark.vertex === undefined || mark.vertex === vertex);
    const color = mark.wrong ? COLORS.wrong : COLORS.good;
    const radius = mark.line ? 6 : 9;
    const ring = { radius, strokeWidth: 5, stroke: "rgba(0,0,0,.65)", listening: false };
    group.add(new Circle({ radius: 10, fill: "transparent" })); // to be hit
    group.add(new Circle(ring));
    group.add(new Circle({ ...ring, strokeWidth: 2.2, stroke: chosen ? COLORS.chosen : color }));
    if (mark.wrong) {
      for (const sign of [1, -1]) {
        group.add(
          new Line({
            points: [-7, -7 * sign, 7, 7 * sign],
            stroke: color,
            strokeWidth: 2.2,
            listening: false,
          }),
        );
      }
    }
    group.add(new Circle({ radius: 1.1, fill: chosen ? COLORS.chosen : color, listening: false }));
    if (mark.chosen && vertex === (mark.vertex ?? 0)) {
      group.add(
        new Text({
          text: mark.name.replaceAll("_", " "),
          x: 14,
          y: -22,
          fontSize: 13,
          fontFamily: "system-ui, sans-serif",
          fill: "#fff",
          stroke: "rgba(0,0,0,.75)",
          strokeWidth: 3,
          fillAfterStrokeEnabled: true,
          listening: false,
        }),
      );
    }
    const now = () => [group.x(), group.y()];
    group.on("mousedown touchstart", () => (this.held = true));
    group.on("click tap", () => this.events.clickMark?.(mark, vertex, this.#place()));
    group.on("dragstart", () => this.events.dragStart?.(mark, vertex));
    group.on("dragmove", () => {
      group.x(Math.max(-0.5, Math.min(this.size[0] - 0.5, group.x())));
      group.y(Math.max(-0.5, Math.min(this.size[1] - 0.5, group.y())));
      this.events.dragMove?.(mark, vertex, now());
    });
    group.on("dragend", () => this.events.dragEnd?.(mark, vertex, now()));
    return group;
  }

  #paint(context) {
    const canvas = context._context;
    const scale = this.stage.scaleX();
    if (this.showLines && this.lines.length) {
      canvas.save();
      canvas.beginPath();
      canvas.rect(-0.5, -0.5, this.size[0], this.size[1]);
      canvas.clip();
      canvas.beginPath();
      for (const line of this.lines) {
        canvas.moveTo(line[0][0], line[0][1]);
        for (const [x, y] of line) canvas.lineTo(x, y);
      }
      canvas.lineJoin = "round";
      canvas.strokeStyle = "rgba(0,0,0,.5)";
      canvas.lineWidth = 3 / scale;
      canvas.stroke();
      canvas.strokeStyle = COLORS.pitch;
      canvas.lineWidth = 1.4 / scale;
      canvas.stroke();
      canvas.restore();
    }
    for (const { from, to, wrong } of this.residuals) {
      canvas.beginPath();
      canvas.moveTo(...from);
      canvas.lineTo(...to);
      canvas.strokeStyle = wrong ? COLORS.wrong : COLORS.good;
      canvas.lineWidth = 2 / scale;
      canvas.stroke();
    }
    if (this.ghost) {
      const [x, y] = this.ghost;
      canvas.beginPath();
      canvas.arc(x, y, 13 / scale, 0, 2 * Math.PI);
      canvas.setLineDash([4 / scale, 4 / scale]);
      canvas.strokeStyle = COLORS.chosen;
      canvas.lineWidth = 2 / scale;
      canvas.stroke();
      canvas.setLineDash([]);
    }
  }
}
