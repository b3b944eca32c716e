/** What is asked for twice: a button that is pressed again before it has done its work, and an answer that is overtaken by a later one. */

const busy = new WeakSet();

/**
 * Do something, unless it is still being done.
 * @param {object} what That is pressed, or anything else that stands for the action.
 * @param {function(): Promise<any>} action
 */
export async function once(what, action) {
  if (busy.has(what)) return undefined;
  busy.add(what);
  try {
    return await action();
  } finally {
    busy.delete(what);
  }
}

/** Return a function that is called when something is asked for, and returns a function that says whether nothing was asked for since. */
export function newest() {
  let last = null;
  return () => {
    const mine = {};
    last = mine;
    return () => last === mine;
  };
}
