/** Repeats what failed because the network or the server was away, and says so in the header of the page meanwhile. */

import { byId } from "./element.js";

const WAITS_S = [0.25, 0.5, 1, 2, 4, 8, 15]; // half a minute in all, in which a server that is restarted answers again
const LONGEST_WAIT_S = 15;
const waiting = new Map();

/** Say in the header why something waits; `who` is any object that stands for it, and an empty sentence ends it. */
export function say(who, sentence) {
  if (sentence === "") waiting.delete(who);
  else waiting.set(who, sentence);
  const place = byId("connection");
  place.textContent = [...waiting.values()].at(-1) ?? "";
  place.hidden = waiting.size === 0;
}

/** Wait some seconds, or until the browser says that the network is back. */
export function pause(seconds) {
  return new Promise((resolve) => {
    const over = () => {
      clearTimeout(timer);
      removeEventListener("online", over);
      resolve();
    };
    const timer = setTimeout(over, 1000 * seconds);
    addEventListener("online", over);
  });
}

/** Return what is said while something waits to be asked again. */
export function lost(seconds) {
  return `The connection is lost. Trying again in ${Math.max(1, Math.round(seconds))} s …`;
}

/**
 * Do something that changes nothing until it succeeds, for about half a minute.
 * @param {function(number): Promise<any>} action Given how often it has failed.
 * @param {function(Error): boolean} passes Whether an error may pass, so that it helps to try again.
 */
export async function repeated(action, passes) {
  const who = {};
  try {
    for (let failed = 0; ; failed += 1) {
      try {
        return await action(failed);
      } catch (error) {
        if (failed === WAITS_S.length || !passes(error)) throw error;
        if (failed > 0) say(who, lost(WAITS_S[failed]));
        await pause(WAITS_S[failed]);
      }
    }
  } finally {
    say(who, "");
  }
}

/** Return whether the server answers. */
async function answers() {
  try {
    return (await fetch("/healthz", { cache: "no-store" })).ok;
  } catch {
    return false;
  }
}

/** Load the page again when the server answers; its address says what it shows. */
export async function reloadWhenBack() {
  const who = {};
  for (let wait = 1; !(await answers()); wait = Math.min(2 * wait, LONGEST_WAIT_S)) {
    say(who, lost(wait));
    await pause(wait);
  }
  location.reload();
}
