/** A name as one word of a shell, whatever is in it: commands of the page are copied and run. */
export const quoted = (name: string): string => `'${name.replaceAll("'", "'\\''")}'`;
