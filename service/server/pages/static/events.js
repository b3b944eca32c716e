/**
 * Changes of jobs as server-sent events, read with fetch because EventSource sends no Authorization header.
 *
 * A broken connection is opened again, with the id of the last event, after 1, 2, 4 … 15 seconds. The header of the page says so meanwhile.
 */

import { credentials, refusal } from "./api.js";
import { lost, pause, say } from "./repeat.js";

const SILENCE_MS = 40_000; // the server says something every 15 s: after this the connection counts as broken
const LONGEST_WAIT_S = 15;

/**
 * Watch a stream of events until it ends.
 * @param {string} path Of the stream.
 * @param {Object<string, function(any): void>} handlers By the name of the event.
 * @param {{onopen?: function(): void, signal?: AbortSignal}} [options] `onopen` is called whenever the connection opens.
 */
export async function watch(path, handlers, { onopen = () => {}, signal = undefined } = {}) {
  let last = null;
  let wait = 1;
  const who = {};
  for (;;) {
    try {
      const ended = await once(path, handlers, () => last, (id) => { last = id; }, () => { wait = 1; say(who, ""); onopen(); }, signal);
      if (ended) return;
    } catch (error) {
      if (signal?.aborted) {
        say(who, "");
        return;
      }
      if (error.final) {
        say(who, "");
        throw error;
      }
    }
    say(who, lost(wait));
    await pause(wait);
    wait = Math.min(2 * wait, LONGEST_WAIT_S);
  }
}

async function once(path, handlers, last, keep, opened, signal) {
  const silence = new AbortController();
  const abort = () => silence.abort();
  signal?.addEventListener("abort", abort);
  let timer = setTimeout(abort, SILENCE_MS);
  try {
    const known = last() === null ? {} : { "Last-Event-ID": last() };
    const answer = await fetch(path, { headers: { Accept: "text/event-stream", ...credentials(), ...known }, signal: silence.signal });
    if (answer.status === 204) return true;
    if (!answer.ok) {
      const error = await refusal(answer);
      error.final = answer.status < 500 && answer.status !== 429;
      throw error;
    }
    opened();
    const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
    const parser = new EventParser();
    let ended = false;
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return ended;
      clearTimeout(timer);
      timer = setTimeout(abort, SILENCE_MS);
      for (const event of parser.add(value)) {
        if (event.id !== null) keep(event.id);
        const data = JSON.parse(event.data);
        handlers[event.name]?.(data);
        ended = event.id !== null && ["succeeded", "failed", "cancelled"].includes(data.state); // a stream of one job ends with it
      }
    }
  } finally {
    clearTimeout(timer);
    signal?.removeEventListener("abort", abort);
  }
}

/** Takes the text of a stream apart (https://html.spec.whatwg.org/multipage/server-sent-events.html, section 9.2.6). */
class EventParser {
  #rest = "";
  #event = { name: "message", data: [], id: null };

  /** Return the events that a further piece of text completes. */
  add(text) {
    const lines = (this.#rest + text).split(/\r\n|\n/);
    this.#rest = lines.pop();
    const found = [];
    for (const line of lines) {
      if (line === "") {
        if (this.#event.data.length > 0) found.push({ ...this.#event, data: this.#event.data.join("\n") });
        this.#event = { name: "message", data: [], id: null };
        continue;
      }
      const [, field, value] = /^([^:]*):? ?(.*)$/s.exec(line);
      if (field === "event") this.#event.name = value;
      else if (field === "data") this.#event.data.push(value);
      else if (field === "id") this.#event.id = value;
    }
    return found;
  }
}
