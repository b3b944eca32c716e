// Shows one pattern after another, pixel by pixel, and tells when each has been painted.

const canvas = document.querySelector("canvas");
const words = document.querySelector("p");
const context = canvas.getContext("2d");
const painted = () => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
const pause = (ms) => new Promise((done) => setTimeout(done, ms));

async function fill() {
  await document.documentElement.requestFullscreen().catch(() => {}); // where the browser refuses, F11 does it
}
addEventListener("click", fill);
addEventListener("keydown", fill);

async function show(number) {
  const image = new Image();
  image.src = `/pattern.png?number=${number}`;
  await image.decode();
  if (canvas.width !== image.naturalWidth || canvas.height !== image.naturalHeight) {
    canvas.width = image.naturalWidth;
    canvas.height = image.naturalHeight;
  }
  canvas.style.width = `${image.naturalWidth / devicePixelRatio}px`; // one pixel of the pattern is one of the screen
  canvas.style.height = `${image.naturalHeight / devicePixelRatio}px`;
  context.drawImage(image, 0, 0);
  words.hidden = true;
  await painted();
}

let shown = 0;
for (;;) {
  try {
    const size = `width=${Math.round(innerWidth * devicePixelRatio)}&height=${Math.round(innerHeight * devicePixelRatio)}`;
    const answer = await (await fetch(`/next?after=${shown}&${size}`)).json();
    if (answer.number === null) continue;
    await show(answer.number);
    shown = answer.number;
    await fetch(`/shown?number=${shown}`, { method: "POST" });
  } catch {
    await pause(200); // the capture has ended, or has not begun
  }
}
