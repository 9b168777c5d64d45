// What a mouse or fingers do on a canvas: drag, pinch, or press without dragging.

const TAP_PX = 5;

// Tell what is done, with pixels of the page; `fingers` holds those that are down:
//   pressed(event), dragged(event, [x, y]), pinched(event, factor, [x, y]), tapped(event), hovered(event).
export function connectGestures(canvas, fingers, { pressed = () => {}, dragged, pinched, tapped, hovered = () => {} }) {
  const apart = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
  canvas.addEventListener("pointerdown", (event) => {
    const at = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { first: at, last: at });
    // Of several fingers none taps.
    for (const finger of fingers.values()) finger.far = fingers.size > 1;
    pressed(event);
  });
  canvas.addEventListener("pointermove", (event) => {
    const finger = fingers.get(event.pointerId), now = [event.clientX, event.clientY];
    if (!finger) return hovered(event);
    const { first, last } = finger, moved = [now[0] - last[0], now[1] - last[1]];
    Object.assign(finger, { last: now, far: finger.far || apart(now, first) > TAP_PX });
    const [, other] = [...fingers].find(([id]) => id !== event.pointerId) ?? [];
    if (other) pinched(event, (apart(last, other.last) || 1) / (apart(now, other.last) || 1), [moved[0] / 2, moved[1] / 2]);
    else if (finger.far) dragged(event, moved);
    return undefined;
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, (event) => {
      const finger = fingers.get(event.pointerId);
      fingers.delete(event.pointerId);
      if (kind === "pointerup" && finger && !finger.far) tapped(event);
    });
  }
}
