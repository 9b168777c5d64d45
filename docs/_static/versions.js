// Lists the versions of these pages that lie beside this one, from versions.json one folder up.
// Where there is none, as on a single version or in files opened without a host, nothing is shown.
"use strict";

document.addEventListener("DOMContentLoaded", async () => {
  const place = document.getElementById("versions");
  if (!place) return;
  const root = new URL(document.documentElement.dataset.content_root || "./", location.href);
  let versions;
  try {
    versions = await (await fetch(new URL("../versions.json", root))).json();
  } catch {
    return;
  }
  const page = location.href.slice(root.href.length);
  const choice = document.createElement("select");
  choice.setAttribute("aria-label", "Version of these pages");
  for (const version of versions) choice.add(new Option(version, version, false, version === place.dataset.version));
  choice.addEventListener("change", async () => {
    const other = new URL(`../${choice.value}/`, root);
    const same = new URL(page, other);
    // A page that the other version does not have leads to its first page.
    const there = await fetch(same, { method: "HEAD" }).then((answer) => answer.ok, () => false);
    location.href = there ? same : other;
  });
  place.append("Version ", choice);
});
