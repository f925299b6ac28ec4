// The page that plays CartPole as an actor of the run.

import { Actor, RefusedError } from "./actor.js";
import { fallen, start, stepped } from "./cartpole.js";
import { byId, setText } from "./dom.js";
import { Drawing } from "./drawing.js";

const STEP_MILLISECONDS = 20;
const PAUSE_MILLISECONDS = 2000; // before another attempt
const LONGEST = { "CartPole-v1": 500, "CartPole-v0": 200 }; // steps of an episode

const drawing = new Drawing(byId("cart"));
let playing = null; // what is under way; another object takes its place

const wait = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const say = (text) => setText(byId("status"), text);

/** Play episodes until another game takes the place of this one. */
async function play(game) {
  while (playing === game) {
    try {
      game.actor = new Actor(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/actor`);
      say("Joining the run...");
      const welcome = await game.actor.join(byId("name").value, byId("token").value);
      const longest = LONGEST[welcome.environment];
      if (longest === undefined) {
        throw new RefusedError(`the run plays ${welcome.environment}, and this page can play CartPole only`, true);
      }
      byId("elsewhere").hidden = true;
      say(`Playing as ${welcome.name}, an actor of the run ${welcome.run}. It learns from these steps.`);
      while (playing === game) await playEpisode(game, longest);
    } catch (error) {
      if (playing !== game) break;
      game.actor.close();
      byId("elsewhere").hidden = !error.misfit;
      if (error instanceof RefusedError) return stop(`Not playing: ${error.message}.`);
      say(`${error.message}; trying again soon.`);
      await wait(PAUSE_MILLISECONDS);
    }
  }
  game.actor.close();
}

async function playEpisode(game, longest) {
  let [state, steps, terminated] = [start(), 0, false];
  while (!terminated && steps < longest && playing === game) {
    const began = performance.now();
    state = stepped(state, await game.actor.act(state, steps ? 1 : null));
    terminated = fallen(state);
    steps += 1;
    drawing.show(state);
    setText(byId("steps"), steps);
    if (!byId("fast").checked) await wait(Math.max(0, STEP_MILLISECONDS - (performance.now() - began)));
  }
  if (playing !== game) return;
  game.actor.endEpisode(terminated, state, 1);
  setText(byId("episodes"), (game.episodes += 1));
  setText(byId("best"), (game.best = Math.max(game.best, steps)));
}

function stop(text) {
  playing?.actor?.close();
  playing = null;
  say(text);
  setText(byId("switch"), "Play");
}

function begin() {
  playing = { actor: null, episodes: 0, best: 0 };
  setText(byId("switch"), "Stop playing");
  play(playing);
}

byId("name").value = `browser-${Math.random().toString(36).slice(2, 8)}`;
byId("settings").onsubmit = (event) => {
  event.preventDefault();
  if (playing) stop("Not playing.");
  else begin();
};
drawing.show([0, 0, 0, 0]);
begin();
