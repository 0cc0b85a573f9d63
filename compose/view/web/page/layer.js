// A picture of what stays the same in many frames: it is drawn once, and while the camera eases, it moves with it.

const PAD = 128; // the pixels of the canvas around the plane that are drawn, too

/** A part of the plane with a canvas of its own; what is drawn in each frame needs none. */
export class Layer {
  /** `zoomed` is the part by which the picture is scaled at most while the camera eases. */
  constructor(plane, zoomed) {
    Object.assign(this, { plane, zoomed, canvas: document.createElement("canvas") });
    this.pen = this.canvas.getContext("2d");
  }

  #told = "";
  /** The camera with which the picture is drawn. */
  #centre = [0, 0];
  #scale = 1;

  /**
   * Copies the picture to the plane. `draw` draws it again if `told`, which names all that it shows, or the camera has
   * changed; while that eases, only once it has moved far.
   */
  show(told, ratio, draw) {
    const { plane, canvas, pen } = this, { width, height } = plane.canvas, size = { width: width + 2 * PAD, height: height + 2 * PAD };
    const moved = plane.scale !== this.#scale || plane.centre.some((one, i) => one !== this.#centre[i]);
    if (told !== this.#told || (moved && (!plane.easing || this.#far()))) {
      for (const [name, pixels] of Object.entries(size)) if (canvas[name] !== pixels) canvas[name] = pixels;
      pen.setTransform(1, 0, 0, 1, 0, 0);
      pen.clearRect(0, 0, size.width, size.height);
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.lineCap = pen.lineJoin = "round";
      plane.padded(PAD / ratio, pen, draw);
      [this.#told, this.#centre, this.#scale] = [told, plane.centre, plane.scale];
    }
    const near = Math.abs(plane.scale / this.#scale - 1) * Math.max(width, height) < 1, zoom = near ? 1 : plane.scale / this.#scale; // within a pixel
    const extent = [size.width, size.height].map((one) => zoom * one), corner = plane.at(this.#centre).map((one, i) => ratio * one - extent[i] / 2);
    plane.context.save();
    plane.context.setTransform(1, 0, 0, 1, 0, 0);
    plane.context.drawImage(canvas, ...(near ? corner.map(Math.round) : corner), ...extent);
    plane.context.restore();
  }

  /** Returns whether the camera is too far from that of the picture: part of the plane would be empty, or the picture blurred. */
  #far() {
    const { plane } = this, size = [plane.width, plane.height], zoom = plane.scale / this.#scale, pad = (PAD * plane.width) / plane.canvas.width;
    const covered = (one, i) => Math.abs(one - size[i] / 2) + size[i] / 2 <= zoom * (size[i] / 2 + pad);
    return Math.abs(zoom - 1) > this.zoomed || !plane.at(this.#centre).every(covered);
  }
}
