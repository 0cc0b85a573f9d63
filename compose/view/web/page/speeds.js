// The speeds of playback, in ticks per second.

export const SPEEDS = [0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
export const USUAL = 5;
