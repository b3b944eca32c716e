/** A capture that is lit live, and sent to the batch as it is shown. */

import { attempt, submitJob } from "../api.js";
import { element } from "../element.js";
import { loadEnvironment } from "../environments.js";
import { commandOf, curlOf } from "../form.js";
import { once } from "../once.js";
import { mount, turnedAside } from "../view/light/relight_viewer.js";
import { mountAnnotations } from "./annotations.js";
import { warningsOf } from "./results.js";
import { mountVideo } from "./video.js";

const FIRST_FRAME = 1;
const FOUND = "The lights of this picture are those that the solve has found. Frames are rendered of a capture whose lights are measured.";

/**
 * Light a capture.
 * @param {HTMLElement} parent Takes it.
 * @param {string} capture Identifier.
 * @param {import("../view/view_file.js").ViewFile} view Of it.
 * @param {{id: string, name: string}[]} environments Of the server.
 * @param {{canRender?: boolean, submitted?: function(any): void}} [options] Whether the batch has these lights, which are not of a solve alone; who gets its job.
 */
export async function mountLight(parent, capture, view, environments, { canRender = true, submitted = ({ id }) => location.assign(`/jobs/${id}`) } = {}) {
  const batch = {
    last: element("input", { type: "text", inputmode: "numeric", value: "24", size: 5, autocomplete: "off" }),
    spin: element("input", { type: "text", inputmode: "decimal", value: "360", size: 6, autocomplete: "off" }),
    fault: element("p", { class: "fault", role: "alert", hidden: true }),
    command: element("pre", { tabindex: 0, "data-shows": "command" }), keys: element("pre", { tabindex: 0, "data-shows": "keys" }), curl: element("pre", { tabindex: 0, "data-shows": "curl" }),
  };
  let light = null;

  /** Return the job that makes what is shown: the first frame as it is now, then the environment turning on, or the light where there is none. */
  function request() {
    const frames = Number(batch.last.value);
    const spin = Number(batch.spin.value);
    if (!Number.isInteger(frames) || frames < 1) throw new Error(`Frames: is ${batch.last.value}: give a whole number from 1`);
    if (!Number.isFinite(spin)) throw new Error(`Spin: is ${batch.spin.value}: give a number of degrees`);
    if (light === null) throw new Error("There is no picture to render here: submit a job with light keys on the page of the capture");
    if (light.light === null && light.environment === null) throw new Error("Nothing lights the object: switch the light on, or choose an environment");
    if (light.environment !== null && light.environment.id === null) {
      throw new Error(`${light.environment.name} is a file of this machine: upload it on the page of captures, and choose it above`);
    }
    const keys = { schema: "relit.keys/1" };
    if (light.light !== null) {
      keys.lights = [{ name: "key", color_space: "lin_rec709_scene", keys: Array.from({ length: spin !== 0 && light.environment === null ? frames : 1 }, (_, at) => (
        { frame: FIRST_FRAME + at, ...light.light, direction: turnedAside(light.light.direction, (spin * at) / frames) })) }];
    }
    if (light.environment !== null) {
      const { turn_degrees: turn, exposure } = light.environment;
      keys.environment = [{ frame: FIRST_FRAME, turn_degrees: turn, exposure }];
      if (frames > 1 && spin !== 0) keys.environment.push({ frame: FIRST_FRAME + frames, turn_degrees: turn + spin, exposure });
    }
    const options = { frames: `${FIRST_FRAME}-${frames}`, weights: "kernel", exposure: light.exposure };
    return { kind: "relight", capture, ...(light.environment === null ? {} : { environment: light.environment.id }), keys, options };
  }

  function present() {
    try {
      const job = request();
      batch.fault.hidden = true;
      const options = [{ flag: "", value: capture, isArgument: true }];
      if (job.environment !== undefined) options.push({ flag: "--environment", value: job.environment });
      options.push({ flag: "--keys", value: "keys.json" }, { flag: "--frames", value: job.options.frames }, { flag: "--weights", value: "kernel" }, { flag: "--exposure", value: String(job.options.exposure) });
      batch.command.textContent = commandOf("relight", options);
      batch.keys.textContent = JSON.stringify(job.keys, null, 1);
      batch.curl.textContent = curlOf(job);
    } catch (error) {
      batch.fault.textContent = error.message;
      batch.fault.hidden = false;
      for (const each of [batch.command, batch.keys, batch.curl]) each.textContent = error.message;
    }
  }

  async function submit() {
    present();
    if (!batch.fault.hidden) return;
    submitted(await submitJob(request()));
  }

  function batchForm() {
    for (const each of [batch.last, batch.spin]) each.addEventListener("input", present);
    return element("section", { "aria-label": "Frames" }, element("h2", {}, "Render these frames"),
      element("form", { novalidate: true, onsubmit: (event) => { event.preventDefault(); attempt(() => once(event.target, submit)); } },
        element("p", { class: "actions" }, element("label", {}, "Frames ", batch.last), element("label", {}, "Spin (degrees) ", batch.spin),
          element("button", { type: "submit" }, "Render")), batch.fault,
        element("details", { class: "same-as" }, element("summary", {}, "The same as a command"), batch.command, element("p", {}, "with this keys.json:"), batch.keys,
          element("p", {}, "With curl:"), batch.curl)));
  }

  if (view.info.relight === null) throw new Error("this capture has too few lights to relight it: four or more are needed");
  const [stage, notes] = [element("div"), element("div")];
  parent.replaceChildren(warningsOf(view), stage, notes, canRender ? batchForm() : element("p", { class: "help" }, FOUND));
  const viewer = await mount(stage, view, { environments, load: loadEnvironment, onchange: (now) => { light = now; present(); } });
  if (viewer.over !== null) await mountAnnotations(notes, capture, viewer.over);
  mountVideo(stage.querySelector(".view-tools"), view.info.name, viewer);
  globalThis.relit = viewer;
}
