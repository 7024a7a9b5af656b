// The filter above the recordings; without it the page is complete.
const words = document.getElementById("words");
const problems = document.getElementById("problems");
const shown = document.getElementById("shown");
const recordings = [...document.querySelectorAll("details.recording")];
function narrow() {
  const wanted = words.value.toLowerCase();
  let count = 0;
  for (const recording of recordings) {
    const fits = recording.dataset.words.toLowerCase().includes(wanted);
    recording.hidden = !fits || (problems.checked && recording.dataset.problem !== "yes");
    count += recording.hidden ? 0 : 1;
  }
  shown.textContent = `${count} of ${recordings.length} recordings`;
}
words.addEventListener("input", narrow);
problems.addEventListener("change", narrow);
document.querySelector(".filter").hidden = false;
window.addEventListener("hashchange", open_target);
function open_target() {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (target && target.matches("details")) target.open = true;
}
open_target();
narrow();
