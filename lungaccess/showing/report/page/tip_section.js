// The cross-section of the airway at the tip of the scope: the border of the lumen around the scope of its true width.
import { DEVICE_COLOURS, TISSUE_COLOURS } from "./colours.js";
import { unpackAll } from "./decode.js";
import { scaleBar } from "./slices.js";

const FREE_INK = "#FFD23F", CROSSED = "#FF8F8A", SECTION_INK = "#F2F2F2";
const SECTION_ROOM = 1.15;

export class TipSection {
  static async of(scope) {
    const { border, gap_mm: gap, nearest, depth_gap_mm: depthGap, arc_length_mm: along, border_step_mm: step } = scope;
    return Object.assign(new TipSection(), await unpackAll({ border, gap, nearest, depthGap, along }), { step, count: border.shape[1] });
  }

  // Return the section of the stored state that is nearest after so much motion.
  at(moved) {
    const { along, count } = this;
    let n = 0;
    while (n + 1 < along.length && Math.abs(along[n + 1] - moved) <= Math.abs(along[n] - moved)) n += 1;
    const border = Array.from(this.border.subarray(n * count, (n + 1) * count), (steps) => this.step * steps);
    return { state: n, border, gap: this.gap[n], nearest: this.nearest[n], depthGap: this.depthGap[n] };
  }

  // Draw it on a canvas with up in the picture as in the bronchoscopy, and say what is free.
  draw(canvas, caption, moved, radius) {
    const { border, gap, nearest, depthGap } = this.at(moved), pen = canvas.getContext("2d"), side = canvas.width;
    const scale = side / 2 / (SECTION_ROOM * Math.max(...border, 1.5 * radius)), middle = side / 2;
    const place = (n, mm) => {
      const angle = (2 * Math.PI * n) / this.count;
      return [middle + scale * mm * Math.sin(angle), middle - scale * mm * Math.cos(angle)];
    };
    pen.fillStyle = TISSUE_COLOURS["airway wall"];
    pen.fillRect(0, 0, side, side);
    pen.beginPath();
    border.forEach((mm, n) => pen.lineTo(...place(n, mm)));
    pen.closePath();
    pen.fillStyle = TISSUE_COLOURS.lumen;
    pen.fill();
    pen.strokeStyle = SECTION_INK;
    pen.lineWidth = 2;
    pen.stroke();
    pen.beginPath();
    pen.arc(middle, middle, scale * radius, 0, 2 * Math.PI);
    pen.fillStyle = DEVICE_COLOURS.scope;
    pen.fill();
    pen.stroke();
    pen.beginPath();
    pen.moveTo(...place(nearest, radius));
    pen.lineTo(...place(nearest, border[nearest]));
    pen.strokeStyle = gap > 0 ? FREE_INK : CROSSED;
    pen.lineWidth = 5;
    pen.stroke();
    scaleBar(pen, scale);
    const hour = Math.round((12 * nearest) / this.count) % 12 || 12;
    const free = gap > 0 ? `${gap.toFixed(1)} mm free at ${hour} o'clock` : `the border of the lumen crosses the scope at ${hour} o'clock`;
    const proved = depthGap > 0 ? `at least ${depthGap.toFixed(1)} mm` : "not proved";
    caption.textContent = `Across the scope's tip (${(2 * radius).toFixed(1)} mm wide), seen along it, as in the bronchoscopy: ${free} in this plane; all around: ${proved}`;
    canvas.setAttribute("aria-label", caption.textContent);
  }
}
