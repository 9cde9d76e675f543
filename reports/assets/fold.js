"use strict";
// Sections after the first one can be folded, and are folded on a narrow screen. report.js stands before it.

const folds = $$("details.fold");
if (matchMedia("(max-width: 700px)").matches) folds.forEach((fold) => { fold.open = false; });

// A link to a section, or to something inside one, opens it.
function reveal() {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!target) return;
  const closed = [$(":scope > details.fold", target), ...folds.filter((fold) => fold.contains(target))].filter((fold) => fold && !fold.open);
  closed.forEach((fold) => { fold.open = true; });
  if (closed.length) target.scrollIntoView({ behavior: "instant" });
  return closed.length > 0 && target;
}
addEventListener("hashchange", reveal);
document.addEventListener("click", ({ target }) => {
  // the same address again is no change of the address
  if (target.closest("a")?.hash === location.hash) reveal();
});
const target = reveal();
if (target) {
  // the place that a reload restores belongs to a page with other sections open
  history.scrollRestoration = "manual";
  // tables above the target are drawn later: it stays in view until the reader does something
  const follow = new ResizeObserver(() => target.scrollIntoView({ behavior: "instant" }));
  follow.observe(document.body);
  for (const act of ["wheel", "touchstart", "keydown", "pointerdown", "click", "hashchange"]) {
    addEventListener(act, () => follow.disconnect(), { once: true, passive: true });
  }
}

// Paper has all sections; afterwards those that were folded are folded again.
let unfolded = [];
addEventListener("beforeprint", () => {
  unfolded = folds.filter((fold) => !fold.open);
  unfolded.forEach((fold) => { fold.open = true; });
});
addEventListener("afterprint", () => unfolded.forEach((fold) => { fold.open = false; }));
