/** Relit frames of an object: a player over small pictures that the server makes of them, a filmstrip, a video, and the files. */

import { attempt, fetched, listing, read, Refusal, warningsIn } from "../api.js";
import { bytes, element, icon } from "../element.js";
import { once } from "../once.js";
import { savingLink } from "./files.js";
import { warningsOf } from "./results.js";
import { offerVideo } from "./video.js";

const FRAME = /^(.*\/)?frame\.\d+\.exr$/;
const PICTURES_PER_S = 24;
const PARALLEL = 3;
const UNREADABLE = "The browser cannot read it.";
const STRIP_PX = 72; // height of the pictures of the filmstrip

/** Show the frames of a job, by its identifier, and load their pictures for as long as the place is on the page; `assumed`: of its capture. */
export async function mountFrames(place, job, assumed) {
  const frames = [];
  for await (const result of listing(`/v1/jobs/${job}/results`, "results", "after")) if (FRAME.test(result.name)) frames.push(result);
  const warnings = warningsIn((await read(`/v1/jobs/${job}/log`)).entries);
  if (frames.length === 0) throw new Error("this job has no frames any more");
  const canvas = element("canvas", { class: "frames-picture", role: "img", "aria-label": "A relit frame" });
  const slider = element("input", { type: "range", min: 0, max: frames.length - 1, step: 1, value: 0, "aria-label": "Frame" });
  const [told, tools] = [element("output", { class: "help" }), element("p", { class: "actions view-tools" })];
  const strip = element("ol", { class: "filmstrip plain", tabindex: 0, "aria-label": "Filmstrip" });
  const files = element("details", {}, element("summary", {}, `${frames.length === 1 ? "The frame" : `All ${frames.length} frames`} as EXR`),
    element("ul", { class: "plain" }, ...frames.map((result) => element("li", {}, savingLink({ name: result.name, result }), ` ${bytes(result.size)}`))));
  const pictures = []; // as the server sends them: decoded, all of them would take thirty times the memory
  const faults = new Map(); // why frames have no picture, by their place
  let [at, playing, isDrawing, drawing] = [0, null, false, null];

  /** Show a frame; while one is decoded, only the last that was asked for waits. Ends when it is shown. */
  function show(index) {
    strip.children[at].firstChild.setAttribute("aria-pressed", "false");
    strip.children[index].firstChild.setAttribute("aria-pressed", "true");
    at = index;
    slider.value = String(index);
    say();
    drawing = isDrawing ? drawing : drawLast();
    return drawing;
  }

  async function drawLast() {
    isDrawing = true;
    for (let drawn = null; drawn !== at;) {
      drawn = at;
      if (pictures[drawn] === undefined) continue;
      try {
        const picture = await createImageBitmap(pictures[drawn]);
        draw(picture);
        picture.close();
      } catch {
        miss(drawn, UNREADABLE);
      }
    }
    isDrawing = false;
  }

  /** Say that a frame has no picture, in the filmstrip and, where it is shown, in place of the picture. */
  function miss(index, why) {
    pictures[index] = undefined;
    faults.set(index, why);
    strip.children[index].firstChild.replaceChildren(icon("warning"));
    say();
  }

  /** Say which frame is shown, and why it has no picture, with a button that asks for those that did not come. */
  function say() {
    const fault = faults.get(at);
    const why = fault !== undefined ? ` has no picture. ${fault}` : pictures[at] === undefined ? ", its picture is being made" : "";
    told.textContent = `${frames[at].name} (${at + 1} of ${frames.length})${why}`;
    canvas.classList.toggle("missing", fault !== undefined); // else it would show the frame before
    again.hidden = faults.size === 0;
    again.textContent = faults.size === 1 ? "Try the missing picture again" : `Try ${faults.size} missing pictures again`;
  }

  function draw(picture) {
    if (canvas.width !== picture.width || canvas.height !== picture.height) [canvas.width, canvas.height] = [picture.width, picture.height];
    canvas.getContext("2d").drawImage(picture, 0, 0);
  }

  function stopPlaying() {
    clearInterval(playing);
    playing = null;
    told.removeAttribute("aria-live");
    play.setAttribute("aria-pressed", "false");
  }

  const again = element("button", { type: "button", class: "quiet", hidden: true, onclick: () => {
    waiting.push(...faults.keys());
    faults.clear();
    say();
    play.focus(); // the button goes
    loadAll();
  } });
  const play = element("button", { type: "button", class: "quiet", "aria-pressed": "false", onclick: () => {
    if (playing !== null) return stopPlaying();
    play.setAttribute("aria-pressed", "true");
    told.setAttribute("aria-live", "off"); // nobody can listen to 24 names a second
    playing = setInterval(() => (canvas.isConnected ? show((at + 1) % frames.length) : stopPlaying()), 1000 / PICTURES_PER_S);
    return undefined;
  } }, "Play");
  slider.addEventListener("input", () => show(Number(slider.value)));

  /** Fetch the picture of a frame; where it does not come, the frame says why. */
  async function fill(index) {
    const path = `/v1/jobs/${job}/pictures/${frames[index].name.split("/").map(encodeURIComponent).join("/")}`;
    try {
      const taken = await fetched(path, (answer) => answer.blob());
      drawSmall(index, await createImageBitmap(taken));
      pictures[index] = taken;
    } catch (error) {
      miss(index, error instanceof Refusal ? error.message : UNREADABLE);
    }
    if (index === at) await show(index);
    else say();
  }

  function drawSmall(index, picture) {
    const small = element("canvas", { height: STRIP_PX });
    small.width = Math.max(1, Math.round((STRIP_PX * picture.width) / picture.height));
    const pen = small.getContext("2d");
    pen.imageSmoothingQuality = "high";
    pen.drawImage(picture, 0, 0, small.width, small.height);
    picture.close();
    strip.children[index].firstChild.replaceChildren(small);
  }

  strip.replaceChildren(...frames.map((_, index) => element("li", {}, element("button", { type: "button", class: "bare", "aria-label": `Frame ${index + 1}`, "aria-pressed": "false",
    onclick: () => show(index) }, element("canvas", { height: STRIP_PX, width: STRIP_PX })))));
  place.replaceChildren(element("div", { class: "stage" }, canvas, element("p", { class: "frames-bar" }, play, slider, told), element("p", { class: "actions" }, again)),
    tools, warningsOf({ info: { findings: [], warnings, assumed: assumed.filter((each) => warnings.includes(each)) } }), strip, files);
  const waiting = frames.map((_, index) => index);
  const loaders = Array.from({ length: PARALLEL }, () => async () => {
    for (let next = waiting.shift(); next !== undefined && canvas.isConnected; next = waiting.shift()) await fill(next);
  });
  const loadAll = () => attempt(async () => {
    await Promise.all(loaders.map((load) => once(load, load))); // those that are at work take what waits
    if (!canvas.isConnected || canvas.dataset.ready !== undefined || frames.some((_, index) => pictures[index] === undefined)) return;
    if (frames.length > 1) offerVideo(tools, `frames-${job}`, canvas, frames.length / PICTURES_PER_S, (share) => {
      stopPlaying();
      return show(Math.min(frames.length - 1, Math.floor(share * frames.length)));
    });
    canvas.dataset.ready = "";
  });
  show(0);
  await fill(waiting.shift());
  loadAll();
}
