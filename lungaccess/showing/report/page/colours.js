// The colours of devices: the one source of them.  lungaccess/showing/report/colours.py reads the object below as JSON, so that
// pictures have them too.
export const DEVICE_COLOURS = {
  "scope": "#0072B2",
  "outer": "#E69F00",
  "middle": "#EDB42E",
  "inner": "#F4C95D",
  "needle": "#D81B60",
  "needle_with_room": "#DDA0F0",
  "target": "#39E0B0",
  "aim": "#FFD23F",
  "others": ["#56B4E9", "#F0E442", "#5B3A8E", "#4F7F2A", "#6B6B6B"]
};

// Of slices.  Each is at least 1.5 times as light as the one before, so that all are told apart on a dark ground, also
// without their hues.
export const TISSUE_COLOURS = {
  outside: "#000000", lung: "#2E3133", lumen: "#19507E", fissure: "#7B5FA5", vessel: "#CF777D", "airway wall": "#85BFE4",
  nodule: "#80FBC4",
};

// Even in lightness, for every colour vision.
export const VIRIDIS = ["#440154", "#3B528B", "#21918C", "#5EC962", "#FDE725"];

// Lengths in mm of the bands of plans beside the first, so that they differ without their colours, too.
const BANDS_MM = [null, [6, 2], [2, 2], [9, 3], [1, 3], [4, 1]];

// Return how a plan is drawn that is not the one followed: its colour, and bands of that colour and of white, in mm.
export function planStyle(n) {
  const { others, needle } = DEVICE_COLOURS;
  if (n === 0) return { colour: needle, bands: BANDS_MM[0] };
  return { colour: others[(n - 1) % others.length], bands: BANDS_MM[1 + ((n - 1) % (BANDS_MM.length - 1))] };
}

// Let the style sheet have the colours: --device-scope, --tissue-vessel and so on.
export function publishColours() {
  const put = (kind) => ([name, colour]) =>
    document.documentElement.style.setProperty(`--${kind}-${name.replace(/[_ ]/g, "-")}`, colour);
  Object.entries(DEVICE_COLOURS).forEach(put("device"));
  Object.entries(TISSUE_COLOURS).forEach(put("tissue"));
}
